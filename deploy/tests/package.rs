//! The recipes in `deploy/package`: every call of the program in them has flags that the program knows.
//! Whether they start where they are for was tried by hand; deploy/docs/src/how-to/install.md says how.

#![allow(clippy::unwrap_used)]

use std::{
    path::{Path, PathBuf},
    process::{Command, Output},
};

fn recipe(name: &str) -> String {
    let path = PathBuf::from(env!("CARGO_MANIFEST_DIR"))
        .join("package")
        .join(name);
    std::fs::read_to_string(&path).unwrap_or_else(|e| panic!("{}: {e}", path.display()))
}

/// The call without its effect: flags are read in their order, and the last one asks for help.
fn help(words: &[String]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_driml"))
        .args(words)
        .arg("--help")
        .env("JOB_COMPLETION_INDEX", "3")
        .env("SLURM_PROCID", "3")
        .output()
        .unwrap()
}

fn check(name: &str, calls: &[Vec<String>], expected: &[&str]) {
    let commands: Vec<_> = calls.iter().map(|words| words[0].as_str()).collect();
    assert_eq!(commands, expected, "{name}");
    for words in calls {
        let output = help(words);
        let said = String::from_utf8(output.stderr).unwrap();
        assert!(
            output.status.success(),
            "{name}: driml {}: {said}",
            words.join(" ")
        );
    }
}

fn words(text: &str) -> Vec<String> {
    let plain = |word: &str| word.trim_matches(['"', ',', '\'', '[', ']']).to_owned();
    text.split_whitespace()
        .map(plain)
        .filter(|word| !word.is_empty())
        .collect()
}

/// The lists under `key`, in a line or an item a line.
fn lists(yaml: &str, key: &str) -> Vec<Vec<String>> {
    let mut lines = yaml
        .lines()
        .map(str::trim)
        .filter(|line| !line.starts_with('#'))
        .peekable();
    let mut found = Vec::new();
    while let Some(line) = lines.next() {
        let Some(rest) = line.strip_prefix(key) else {
            continue;
        };
        let mut list = words(rest);
        while rest.is_empty() && lines.peek().is_some_and(|line| line.starts_with("- ")) {
            list.extend(words(lines.next().unwrap().trim_start_matches("- ")));
        }
        found.push(list);
    }
    found
}

/// `${NAME:-default}` as its default.
fn with_defaults(word: &str) -> String {
    match word.split_once("${") {
        Some((before, rest)) => {
            let (_, default) = rest.trim_end_matches('}').split_once(":-").unwrap();
            format!("{before}{default}")
        }
        None => word.to_owned(),
    }
}

#[test]
fn compose() {
    let calls = lists(&recipe("compose.yaml"), "command:");
    let calls: Vec<Vec<_>> = calls
        .iter()
        .map(|words| words.iter().map(|word| with_defaults(word)).collect())
        .collect();
    check(
        "compose.yaml",
        &calls,
        &["replay-server", "learner", "actor", "actor", "status"],
    );
}

#[test]
fn kubernetes() {
    let calls = lists(&recipe("kubernetes.yaml"), "args:");
    check(
        "kubernetes.yaml",
        &calls,
        &["replay-server", "learner", "actor"],
    );
}

#[test]
fn slurm() {
    let script = recipe("driml.sbatch");
    let calls: Vec<_> = script
        .lines()
        .filter_map(|line| line.strip_prefix("part ")?.split_once("\"$program\" "))
        .map(|(_, call)| words(&call.replace("\"$@\"", "").replace("$actors", "4")))
        .collect();
    check(
        "driml.sbatch",
        &calls,
        &["replay-server", "learner", "actor"],
    );
    let checked = Command::new("bash")
        .args(["-n", "-c", &script])
        .output()
        .unwrap();
    assert!(checked.status.success(), "{checked:?}");
}

#[test]
fn systemd() {
    for (unit, command) in [
        ("driml-replay-server.service", "replay-server"),
        ("driml-learner.service", "learner"),
        ("driml-actor@.service", "actor"),
    ] {
        let unit = recipe(&format!("systemd/{unit}"));
        let start = "ExecStart=/usr/local/bin/driml ";
        let calls: Vec<_> = unit
            .lines()
            .filter_map(|line| line.strip_prefix(start))
            .map(|call| words(&call.replace("$DRIML_SETTINGS", "").replace("%i", "7")))
            .collect();
        check(command, &calls, &[command]);
    }
}

#[test]
fn a_flag_that_is_not_there_is_found() {
    let output = help(&words("actor --conect tcp/127.0.0.1:1"));
    assert_eq!(output.status.code(), Some(64));
}

/// What the image installs and copies is where it says.
#[test]
fn the_image_is_made_of_what_is_there() {
    let file = recipe("Dockerfile");
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).parent().unwrap();
    for copied in file.lines().filter_map(|line| line.strip_prefix("COPY ")) {
        let from = copied.split_whitespace().next().unwrap();
        if from != "--from=build" {
            assert!(root.join(from).exists(), "{copied}");
        }
    }
    let manifest = std::fs::read_to_string(root.join("Cargo.toml")).unwrap();
    assert!(file.contains("--profile dist") && manifest.contains("[profile.dist]"));
    let rust = manifest
        .lines()
        .find_map(|line| line.strip_prefix("rust-version = "))
        .unwrap();
    assert!(
        file.contains(&format!("rust:{}-", rust.trim_matches('"'))),
        "{rust}"
    );
}
