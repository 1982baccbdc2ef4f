//! The program as a user calls it wrongly: each call is answered by a sentence that says what to do, and the right code.
//! No run is started here; the end-to-end tests do that.

#![allow(clippy::unwrap_used)]

use std::{
    path::Path,
    process::{Command, Output},
};

use expect_test::expect;

fn driml(args: &[&str]) -> Output {
    driml_in(Path::new(env!("CARGO_TARGET_TMPDIR")), args)
}

fn driml_in(folder: &Path, args: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_driml"))
        .args(args)
        .current_dir(folder)
        .env_remove("DRIML_LOG")
        .output()
        .unwrap()
}

/// Exit code and stderr.
fn said(args: &[&str]) -> (i32, String) {
    let output = driml(args);
    (
        output.status.code().unwrap(),
        String::from_utf8(output.stderr).unwrap(),
    )
}

fn usage(args: &[&str]) -> String {
    let (code, text) = said(args);
    assert_eq!(code, 64, "{text}");
    text
}

#[test]
fn names_that_nothing_has() {
    expect![[r#"
        error: --env: no world is named "procgen:bigfihs"; did you mean "procgen:bigfish"? (the worlds: procgen:GAME, mspacman, ising, chain, exec:COMMAND, libenv:PATH:GAME; GAME is one of bigfish, bossfight, caveflyer, chaser, climber, coinrun, dodgeball, fruitbot, heist, jumper, leaper, maze, miner, ninja, plunder, starpilot)
    "#]].assert_eq(&usage(&["local", "--env", "procgen:bigfihs"]));
    expect![[r#"
        error: --env: no world is named "pong" (the worlds: procgen:GAME, mspacman, ising, chain, exec:COMMAND, libenv:PATH:GAME; GAME is one of bigfish, bossfight, caveflyer, chaser, climber, coinrun, dodgeball, fruitbot, heist, jumper, leaper, maze, miner, ninja, plunder, starpilot)
    "#]].assert_eq(&usage(&["local", "--env", "pong"]));
    expect![[r#"
        error: there is no agent "driml"; --agent takes c51, rainbow, driml-fix, driml-ada, driml-randk, driml-noact, cpc, curl
    "#]]
    .assert_eq(&usage(&["local", "--agent", "driml"]));
    expect![[r#"
        error: there is no preset "papper" (did you mean "paper"?); --preset takes paper, tuned, paper-observation, split, exact, balanced, fast, smoke (`driml presets` describes them)
    "#]].assert_eq(&usage(&["local", "--preset", "papper"]));
    expect![[r#"
        error: preset "split" is for procgen only, not for mspacman; take --preset paper
    "#]]
    .assert_eq(&usage(&["local", "--preset", "split", "--env", "mspacman"]));
    expect![[r#"
        error: there is no setting "learner.lr" (did you mean "learner.update.adam.lr"?); [learner] has affinity, batch_size, batches_in_flight, checkpoint_period_updates, checkpoints_kept, equal_states, precision, publish_as, publish_period_updates, unreachable_max_ms, update
    "#]].assert_eq(&usage(&["local", "--set", "learner.lr=1"]));
}

#[test]
fn values_that_cannot_work() {
    expect![[r#"
        error: run.gamma = 2 cannot work: a discount lies between 0 and 1
    "#]]
    .assert_eq(&usage(&["local", "--set", "run.gamma=2"]));
    expect![[r#"
        error: --set learner.batch_size=many: the value is a whole number, and many is a word
    "#]]
    .assert_eq(&usage(&["local", "--set", "learner.batch_size=many"]));
    expect![[r#"
        error: 10 frames are no more than the warm-up of 500: ask for more --frames, or --set replay.warmup_transitions=1
    "#]].assert_eq(&usage(&["local", "--env", "chain", "--frames", "10"]));
    expect![[r#"
        error: "localhost" is not an endpoint: use tcp/HOST:PORT, quic/HOST:PORT or unixsock-stream/PATH
    "#]]
    .assert_eq(&usage(&["local", "--listen", "localhost"]));
    expect![[r#"
        error: namespace "a b" cannot be used: take letters, digits, '-' and '_', in parts separated by single '/'
    "#]].assert_eq(&usage(&[
        "actor",
        "--connect",
        "tcp/localhost:1",
        "--namespace",
        "a b",
    ]));
    expect![[r#"
        error: reading the settings no-such.toml: No such file or directory (os error 2)
    "#]]
    .assert_eq(&usage(&["local", "--config", "no-such.toml"]));
}

/// The sentence is that of the number's parser, and not that there is no flag -1.
#[test]
fn a_negative_number_is_a_number_out_of_range() {
    for (flag, why) in [
        ("--seed", "\"-1\" is not a whole number; write one as"),
        ("--frames", "\"-1\" is not a whole number; write one as"),
        ("--actors", "-1 is not in 1..=256"),
    ] {
        let text = usage(&["local", flag, "-1"]);
        assert!(text.contains(why), "{text}");
    }
}

/// It would have to forget what going on exactly needs.
#[test]
fn lockstep_keeps_its_replay_whole_or_says_so() {
    let folder = tempfile::tempdir().unwrap();
    let set = "replay.disk_bytes_max=100000000";
    let args = ["local", "--lockstep", "--env", "chain", "--set", set];
    let output = driml_in(folder.path(), &args);
    let text = String::from_utf8(output.stderr).unwrap();
    assert_eq!(output.status.code(), Some(64), "{text}");
    assert!(
        text.contains("cannot keep it within replay.disk_bytes_max"),
        "{text}"
    );
}

/// A setting without an effect is a mistake, and is said before the plan.
#[test]
fn what_is_for_a_replay_on_disk_needs_one() {
    for set in ["replay.fsync_ms=100", "replay.disk_bytes_max=100000000"] {
        for (args, flag) in [
            (&["local"][..], "--durable"),
            (
                &["replay-server", "--listen", "tcp/127.0.0.1:0"],
                "--replay-dir DIR",
            ),
        ] {
            let args = [args, &["--env", "chain", "--set", set]].concat();
            let text = usage(&args);
            let why = format!(
                "cannot work: this replay is in memory alone; add {flag} to keep it on disk"
            );
            assert!(text.contains(&why), "{text}");
            assert!(
                text.contains("replay.") && !text.contains("trains "),
                "{text}"
            );
        }
    }
}

#[test]
fn clap_s_own_refusals_are_usage_too() {
    for args in [
        &["local", "--frames", "0"][..],
        &["local", "--actors", "0"],
        &["local", "--frames", "ten"],
        &["local", "--colour"],
        &["local", "--config", "x", "--env", "chain"],
        &["local", "--lockstep", "--listen", "tcp/127.0.0.1:1"],
        &["actor"],
        &["fly"],
        &["bench"],
        &["bench", "fly"],
        &["bench", "peers", "--only", "scale"],
        &["bench", "system", "--frames", "10"],
        &[],
    ] {
        usage(args);
    }
    for args in [
        &["--help"][..],
        &["--version"],
        &["local", "--help"],
        &["presets"],
    ] {
        let output = driml(args);
        assert_eq!(output.status.code(), Some(0), "{args:?}");
        assert!(
            !output.stdout.is_empty() && output.stderr.is_empty(),
            "{args:?}"
        );
    }
}

#[test]
fn a_run_folder_in_use_is_not_touched() {
    let folder = tempfile::tempdir().unwrap();
    std::fs::create_dir(folder.path().join("run")).unwrap();
    std::fs::write(folder.path().join("run/metrics.csv"), "old").unwrap();
    let output = driml_in(
        folder.path(),
        &["local", "--env", "chain", "--run-dir", "run"],
    );
    assert_eq!(output.status.code(), Some(64));
    expect![[r#"
        error: the run folder run exists and is not empty: choose another --run-dir, or remove it
    "#]]
    .assert_eq(&String::from_utf8(output.stderr).unwrap());
    assert_eq!(
        std::fs::read_to_string(folder.path().join("run/metrics.csv")).unwrap(),
        "old"
    );
    assert_eq!(
        std::fs::read_dir(folder.path().join("run"))
            .unwrap()
            .count(),
        1
    );
}

#[test]
fn a_config_file_at_odds_with_itself() {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(
        folder.path().join("config.toml"),
        "[run]\nworld = \"chain\"\n",
    )
    .unwrap();
    let output = driml_in(folder.path(), &["local", "--config", "config.toml"]);
    assert_eq!(output.status.code(), Some(64));
    expect![[r#"
        error: config.toml: in the settings' [world] table: missing field `cells`
    "#]]
    .assert_eq(&String::from_utf8(output.stderr).unwrap());
}

#[test]
fn parity_files_that_are_none() {
    let folder = tempfile::tempdir().unwrap();
    // A safetensors file whose header is announced with 100 bytes, cut off after 10.
    let mut cut = 100u64.to_le_bytes().to_vec();
    cut.extend(b"{\"input.fr");
    std::fs::write(folder.path().join("cut.safetensors"), cut).unwrap();
    let in_folder = |args: &[&str]| {
        let output = driml_in(folder.path(), args);
        assert_eq!(output.status.code(), Some(1));
        String::from_utf8(output.stderr).unwrap()
    };
    expect![[r#"
        error: cut.safetensors: not a whole safetensors file: invalid header length
    "#]]
    .assert_eq(&in_folder(&["parity", "cut.safetensors"]));
    expect![[r#"
        error: cannot read none.safetensors: No such file or directory (os error 2)
    "#]]
    .assert_eq(&in_folder(&["parity", "none.safetensors"]));
}

#[test]
fn nobody_to_join_is_a_failure_at_run_time() {
    let folder = tempfile::tempdir().unwrap();
    let endpoint = format!(
        "unixsock-stream/{}",
        folder.path().join("nobody.sock").display()
    );
    let (code, text) = said(&["actor", "--connect", &endpoint]);
    assert_eq!(code, 1, "{text}");
    assert!(text.contains("error: "), "{text}");
    assert!(!text.contains("panicked"), "{text}");
}

#[test]
fn benches_give_figures_and_name_the_peer_that_is_missing() {
    let output = driml(&["bench", "policy", "--quick", "--json", "-"]);
    let report: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    let figures = report["figures"].as_array().unwrap();
    assert_eq!((figures.len(), &report["bench"]), (8, &"policy".into()));
    assert!(figures.iter().all(|it| it["value"].as_f64().unwrap() > 0.0));

    let growth = [
        "bench",
        "learner",
        "--growth",
        "--quick",
        "--precision",
        "bf16",
    ];
    let output = driml(&[&growth[..], &["--json", "-"]].concat());
    let report: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    let figures = report["figures"].as_array().unwrap();
    let speeds = figures.iter().filter(|it| it["unit"] == "GFLOP/s").count();
    assert_eq!((figures.len(), speeds), (26, 13));
    let peers = ["bench", "peers", "--quick", "--only", "policy"];
    let output = driml(&[&peers[..], &["--python", "no-such-python"]].concat());
    let table = String::from_utf8(output.stdout).unwrap();
    assert_eq!(output.status.code(), Some(0), "{table}");
    let skipped = "skipped: no-such-python cannot be started (No such file or directory (os error 2)): name a Python that has PyTorch with --torch-python";
    assert_eq!(
        table
            .lines()
            .filter(|line| line.ends_with("  skipped"))
            .count(),
        8,
        "{table}"
    );
    assert_eq!(
        table.lines().filter(|line| *line == skipped).count(),
        1,
        "{table}"
    );
}

#[test]
fn an_actors_number_from_the_environment() {
    let id = |id: &str, value: &str| {
        let output = Command::new(env!("CARGO_BIN_EXE_driml"))
            .args(["actor", "--connect", "tcp/127.0.0.1:1", "--id", id])
            .env("RANK_OF_A_TEST", value)
            .output()
            .unwrap();
        assert_eq!(output.status.code(), Some(64));
        String::from_utf8(output.stderr).unwrap()
    };
    let said = id("env:NO_SUCH_RANK", "");
    assert!(
        said.contains("the environment has no NO_SUCH_RANK"),
        "{said}"
    );
    let said = id("env:RANK_OF_A_TEST", "x3");
    assert!(said.contains("RANK_OF_A_TEST is \"x3\""), "{said}");
    let said = id("first", "");
    assert!(
        said.contains("a whole number from 0, or env:NAME"),
        "{said}"
    );
    // The number is read: its certificate is what is missing then.
    let output = Command::new(env!("CARGO_BIN_EXE_driml"))
        .args([
            "actor",
            "--connect",
            "quic/127.0.0.1:1",
            "--tls-dir",
            "/nonexistent",
        ])
        .args(["--id", "env:RANK_OF_A_TEST"])
        .env("RANK_OF_A_TEST", "17")
        .output()
        .unwrap();
    let said = String::from_utf8(output.stderr).unwrap();
    assert!(said.contains("actor-17"), "{said}");
}

#[test]
fn completions_and_pages() {
    for (shell, part) in [
        ("bash", "complete -F"),
        ("zsh", "#compdef driml"),
        ("fish", "complete -c driml"),
    ] {
        let output = driml(&["completions", shell]);
        assert!(output.status.success());
        let script = String::from_utf8(output.stdout).unwrap();
        assert!(
            script.contains(part) && script.contains("evaluate-every"),
            "{script}"
        );
    }
    assert!(usage(&["completions", "tcsh"]).contains("bash"));
    let root = tempfile::tempdir().unwrap();
    let out = root.path().join("man1");
    let output = driml(&["man", out.to_str().unwrap()]);
    assert!(output.status.success());
    let page = std::fs::read_to_string(out.join("driml-train.1")).unwrap();
    assert!(page.contains("\\-\\-frames"), "{page}");
    let (code, said) = said(&["man", "/proc/none/man1"]);
    assert_eq!(code, 1);
    assert!(
        said.contains("writing pages into /proc/none/man1"),
        "{said}"
    );
}
