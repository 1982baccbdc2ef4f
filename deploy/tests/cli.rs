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
    Command::new(env!("CARGO_BIN_EXE_driml")).args(args).current_dir(folder).env_remove("DRIML_LOG").output().unwrap()
}

/// Exit code and stderr.
fn said(args: &[&str]) -> (i32, String) {
    let output = driml(args);
    (output.status.code().unwrap(), String::from_utf8(output.stderr).unwrap())
}

fn usage(args: &[&str]) -> String {
    let (code, text) = said(args);
    assert_eq!(code, 64, "{text}");
    text
}

#[test]
fn names_that_nothing_has() {
    expect![].assert_eq(&usage(&["local", "--env", "procgen:bigfihs"]));
    expect![].assert_eq(&usage(&["local", "--env", "pong"]));
    expect![].assert_eq(&usage(&["local", "--agent", "driml"]));
    expect![].assert_eq(&usage(&["local", "--preset", "papper"]));
    expect![].assert_eq(&usage(&["local", "--preset", "split", "--env", "mspacman"]));
    expect![].assert_eq(&usage(&["local", "--set", "learner.lr=1"]));
}

#[test]
fn values_that_cannot_work() {
    expect![].assert_eq(&usage(&["local", "--set", "run.gamma=2"]));
    expect![].assert_eq(&usage(&["local", "--set", "learner.batch_rows=many"]));
    expect![].assert_eq(&usage(&["local", "--env", "chain", "--frames", "10"]));
    expect![].assert_eq(&usage(&["local", "--listen", "localhost"]));
    expect![].assert_eq(&usage(&["actor", "--connect", "tcp/localhost:1", "--namespace", "a b"]));
    expect![].assert_eq(&usage(&["local", "--config", "no-such.toml"]));
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
        &[],
    ] {
        usage(args);
    }
    for args in [&["--help"][..], &["--version"], &["local", "--help"], &["presets"]] {
        let output = driml(args);
        assert_eq!(output.status.code(), Some(0), "{args:?}");
        assert!(!output.stdout.is_empty() && output.stderr.is_empty(), "{args:?}");
    }
}

#[test]
fn a_run_folder_in_use_is_not_touched() {
    let folder = tempfile::tempdir().unwrap();
    std::fs::create_dir(folder.path().join("run")).unwrap();
    std::fs::write(folder.path().join("run/metrics.csv"), "old").unwrap();
    let output = driml_in(folder.path(), &["local", "--env", "chain", "--run-dir", "run"]);
    assert_eq!(output.status.code(), Some(64));
    expect![].assert_eq(&String::from_utf8(output.stderr).unwrap());
    assert_eq!(std::fs::read_to_string(folder.path().join("run/metrics.csv")).unwrap(), "old");
    assert_eq!(std::fs::read_dir(folder.path().join("run")).unwrap().count(), 1);
}

#[test]
fn a_config_file_at_odds_with_itself() {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("config.toml"), "[run]\nworld = \"chain\"\n").unwrap();
    let output = driml_in(folder.path(), &["local", "--config", "config.toml"]);
    assert_eq!(output.status.code(), Some(64));
    expect![].assert_eq(&String::from_utf8(output.stderr).unwrap());
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
    expect![].assert_eq(&in_folder(&["parity", "cut.safetensors"]));
    expect![].assert_eq(&in_folder(&["parity", "none.safetensors"]));
}

#[test]
fn nobody_to_join_is_a_failure_at_run_time() {
    let folder = tempfile::tempdir().unwrap();
    let endpoint = format!("unixsock-stream/{}", folder.path().join("nobody.sock").display());
    let (code, text) = said(&["actor", "--connect", &endpoint]);
    assert_eq!(code, 1, "{text}");
    assert!(text.contains("error: "), "{text}");
    assert!(!text.contains("panicked"), "{text}");
}
