//! Calls that start no run. A wrong one exits with the right code and a sentence that says what to do.
//! The judgement of each fact of `driml doctor` is tested beside its code.

use std::{fs, os::unix::process::CommandExt};

use driml_tests::{Exit, Process};
use expect_test::expect_file;

use crate::{SHORT, system};

/// Each line of the file that starts with `$` is a call; the expected output stands below it.
#[test]
fn calls_that_cannot_work_are_answered_with_what_to_do() {
    let system = system();
    let used = system.path("used");
    fs::create_dir(&used).unwrap();
    fs::write(used.join("metrics.csv"), "old").unwrap();
    fs::write(system.path("odd.toml"), "[run]\nworld = \"chain\"\n").unwrap();
    fs::create_dir(system.path("odd")).unwrap();
    fs::write(system.path("odd/config.toml"), "[run]\n").unwrap();
    let stderr_of = |call: &str| {
        let mut command = system.command(call);
        // The usage text contains the name by which the program was called.
        command.arg0("driml");
        command.envs([("RANK_OF_A_TEST", "x3"), ("OTHER_RANK_OF_A_TEST", "17")]);
        let ended = Process::start(call.into(), command).wait();
        ended.expect_code(64).stderr
    };
    let rows = include_str!("snapshots/refusals.txt").lines();
    let answered = rows.filter_map(|row| match row.strip_prefix("$ driml ") {
        Some(call) => Some(format!("{row}\n{}", stderr_of(call))),
        None => row.starts_with('#').then(|| format!("{row}\n")),
    });
    expect_file!["snapshots/refusals.txt"].assert_eq(&answered.collect::<String>());
    // A folder in use is not touched, and nothing was begun.
    assert_eq!(fs::read(used.join("metrics.csv")).unwrap(), b"old");
    assert_eq!(fs::read_dir(used).unwrap().count(), 1);
    assert_eq!(system.file_names(".").len(), 3);
    assert_eq!(system.running_processes(), []);
}

#[test]
fn a_run_without_engine_or_temporary_folder_leaves_no_run_folder() {
    let system = system();
    let offline = "env DRIML_OFFLINE=1 DRIML_CACHE=none DRIML local --env procgen:coinrun";
    system.run(offline).expect_code(1);
    let run = format!("env TMPDIR=none DRIML local {SHORT}");
    system.rejects(&run, "set TMPDIR to a folder that can be written");
    assert_eq!(system.file_names("runs"), [] as [&str; 0]);
}

#[test]
fn a_call_that_asks_for_help_or_leaves_the_command_out_prints_it() {
    let system = system();
    for call in ["", "bench", "experiment"] {
        system.rejects(call, "Usage: ");
    }
    for call in [
        "--help",
        "--version",
        "local --help",
        "presets",
        "inspect --worlds --preset tuned",
    ] {
        let Exit { stdout, stderr, .. } = system.run_ok(call);
        assert!(!stdout.is_empty() && stderr.is_empty(), "{call}");
    }
}

#[test]
fn benches_give_figures_and_name_the_peer_that_is_missing() {
    let system = system();
    // The number of figures, and how many of them measure arithmetic.
    for (bench, count, of_arithmetic) in [
        ("policy", 16, 0),
        ("learner --growth --precision bf16", 26, 13),
        ("learner --kernels --precision bf16", 6, 6),
        ("replay", 17, 0),
    ] {
        let report = system.run_json(&format!("bench {bench} --quick --json -"));
        let figures = report["figures"].as_array().unwrap();
        assert!(bench.starts_with(report["bench"].as_str().unwrap()));
        assert!(figures.iter().all(|it| it["value"].as_f64().unwrap() > 0.0));
        let of_unit = figures.iter().filter(|it| it["unit"] == "GFLOP/s");
        let counts = (figures.len(), of_unit.count());
        assert_eq!(counts, (count, of_arithmetic), "{bench}");
    }
    let peers = "bench peers --quick --only policy --python no-such-python";
    let table = system.run_ok(peers).stdout;
    const SKIPPED: &str = "skipped: no-such-python cannot be started (No such file or directory (os error 2)): name a Python that has PyTorch with --torch-python";
    let lines = |is: fn(&str) -> bool| table.lines().filter(|line| is(line)).count();
    assert_eq!(lines(|line| line.ends_with("  skipped")), 16, "{table}");
    assert_eq!(lines(|line| line == SKIPPED), 1, "{table}");
}

#[test]
fn completions_and_pages() {
    let system = system();
    for (shell, text) in [
        ("bash", "complete -F"),
        ("zsh", "#compdef driml"),
        ("fish", "complete -c driml"),
    ] {
        let ended = system.run_ok(&format!("completions {shell}"));
        ended.expect_stdout(text).expect_stdout("eval-interval");
    }
    system.run_ok("man man1");
    let page = system.read("man1/driml-train.1");
    assert!(page.contains("\\-\\-frames"), "{page}");
}

/// The doctor looks at whatever machine runs these tests.
#[test]
fn the_doctor_names_what_the_machine_has_and_ends_as_it_says() {
    let system = system();
    let ended = system.run("doctor");
    let facts = "cores, vectors, memory, shared memory, locked memory, disk, Procgen, cuda";
    for what in facts.split(", ") {
        let states = ["ok", "note", "missing"].map(|state| format!("{state:<8} {what}"));
        let is_line = |line: &str| states.iter().any(|state| line.starts_with(state));
        assert!(ended.stdout.lines().any(is_line), "{what}: {ended:#?}");
    }
    // Without a network Procgen's engine may be missing.
    let trains = ended.stdout.contains("This machine can train on the CPU");
    ended.expect_code(i32::from(!trains));
    let facts = system.run("doctor --json").json();
    let facts = facts.as_array().unwrap();
    assert!(facts.len() >= 8, "{facts:?}");
    assert_eq!(facts[0]["what"], "cores");
    assert!(facts.iter().all(|fact| fact["state"].is_string()));
}
