//! The program as a user calls it wrongly: each call is answered by a sentence that says what to do, and the right code.
//! No run is started here; the end-to-end tests do that.

#![allow(clippy::unwrap_used)]

use std::{
    fs,
    path::Path,
    process::{Command, Output},
};

use expect_test::expect_file;

fn driml(call: &str) -> Output {
    driml_in(Path::new(env!("CARGO_TARGET_TMPDIR")), call)
}

/// Runs the program with these words.
fn driml_in(folder: &Path, call: &str) -> Output {
    Command::new(env!("CARGO_BIN_EXE_driml"))
        .args(call.split_whitespace())
        .current_dir(folder)
        .env_remove("DRIML_LOG")
        .env("RANK_OF_A_TEST", "x3")
        .env("OTHER_RANK_OF_A_TEST", "17")
        .output()
        .unwrap()
}

/// What a call says that ends with this exit code.
fn said(folder: &Path, call: &str, code: i32) -> String {
    let output = driml_in(folder, call);
    let text = String::from_utf8(output.stderr).unwrap();
    assert_eq!(output.status.code(), Some(code), "{call}: {text}");
    text
}

fn usage(call: &str) -> String {
    said(Path::new(env!("CARGO_TARGET_TMPDIR")), call, 64)
}

/// A row of the file is a call; the answer stands below it.
#[test]
fn calls_that_cannot_work_are_answered_with_what_to_do() {
    let folder = tempfile::tempdir().unwrap();
    let used = folder.path().join("used");
    fs::create_dir(&used).unwrap();
    fs::write(used.join("metrics.csv"), "old").unwrap();
    fs::write(folder.path().join("odd.toml"), "[run]\nworld = \"chain\"\n").unwrap();
    let rows = include_str!("snapshots/refusals.txt").lines();
    let answered = rows.filter_map(|row| match row.strip_prefix("$ driml ") {
        Some(call) => Some(format!("{row}\n{}", said(folder.path(), call, 64))),
        None => row.starts_with('#').then(|| format!("{row}\n")),
    });
    expect_file!["snapshots/refusals.txt"].assert_eq(&answered.collect::<String>());
    // A folder in use is not touched.
    assert_eq!(fs::read(used.join("metrics.csv")).unwrap(), b"old");
    assert_eq!(fs::read_dir(used).unwrap().count(), 1);
}

#[test]
fn a_call_that_asks_for_help_or_leaves_the_command_out_prints_it() {
    for call in ["", "bench", "experiment"] {
        assert!(usage(call).contains("Usage: "), "{call}");
    }
    for call in ["--help", "--version", "local --help", "presets"] {
        let output = driml(call);
        assert_eq!(output.status.code(), Some(0), "{call}");
        assert!(
            !output.stdout.is_empty() && output.stderr.is_empty(),
            "{call}"
        );
    }
}

/// These can only be known at run time: exit code 1.
#[test]
fn files_and_runs_that_are_not_there() {
    let folder = tempfile::tempdir().unwrap();
    // A safetensors file whose header is announced with 100 bytes, cut off after 10.
    let mut cut = 100u64.to_le_bytes().to_vec();
    cut.extend(b"{\"input.fr");
    fs::write(folder.path().join("cut.safetensors"), cut).unwrap();
    for (call, why) in [
        (
            "parity cut.safetensors",
            "error: cut.safetensors: not a whole safetensors file: invalid header length\n",
        ),
        (
            "parity none.safetensors",
            "error: cannot read none.safetensors: No such file or directory (os error 2)\n",
        ),
        ("actor --connect unixsock-stream/absent.sock", "error: "),
        ("man /proc/none/man1", "writing pages into /proc/none/man1"),
    ] {
        let text = said(folder.path(), call, 1);
        assert!(
            text.contains(why) && !text.contains("panicked"),
            "{call}: {text}"
        );
    }
}

#[test]
fn benches_give_figures_and_name_the_peer_that_is_missing() {
    // How many figures, and how many of them are of arithmetic.
    for (bench, count, of_arithmetic) in [
        ("policy", 12, 0),
        ("learner --growth --precision bf16", 26, 13),
        ("learner --kernels --precision bf16", 6, 6),
    ] {
        let output = driml(&format!("bench {bench} --quick --json -"));
        let report: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
        let figures = report["figures"].as_array().unwrap();
        assert!(bench.starts_with(report["bench"].as_str().unwrap()));
        assert!(figures.iter().all(|it| it["value"].as_f64().unwrap() > 0.0));
        let of_unit = figures.iter().filter(|it| it["unit"] == "GFLOP/s");
        let counts = (figures.len(), of_unit.count());
        assert_eq!(counts, (count, of_arithmetic), "{bench}");
    }
    let output = driml("bench peers --quick --only policy --python no-such-python");
    let table = String::from_utf8(output.stdout).unwrap();
    assert_eq!(output.status.code(), Some(0), "{table}");
    const SKIPPED: &str = "skipped: no-such-python cannot be started (No such file or directory (os error 2)): name a Python that has PyTorch with --torch-python";
    let lines = |is: fn(&str) -> bool| table.lines().filter(|line| is(line)).count();
    assert_eq!(lines(|line| line.ends_with("  skipped")), 12, "{table}");
    assert_eq!(lines(|line| line == SKIPPED), 1, "{table}");
}

#[test]
fn completions_and_pages() {
    for (shell, text) in [
        ("bash", "complete -F"),
        ("zsh", "#compdef driml"),
        ("fish", "complete -c driml"),
    ] {
        let output = driml(&format!("completions {shell}"));
        assert!(output.status.success());
        let script = String::from_utf8(output.stdout).unwrap();
        let has = |text| script.contains(text);
        assert!(has(text) && has("eval-interval"), "{script}");
    }
    let root = tempfile::tempdir().unwrap();
    assert!(driml_in(root.path(), "man man1").status.success());
    let page = fs::read_to_string(root.path().join("man1/driml-train.1")).unwrap();
    assert!(page.contains("\\-\\-frames"), "{page}");
}
