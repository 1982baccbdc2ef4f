//! The recipes in `deploy/package`: every call of the program in them has flags that the program knows.
//! The recipes were started by hand on their platforms; deploy/docs/src/how-to/install.md describes how.

use std::{fs, process::Command};

use clap::Parser;

use crate::{cli::Cli, reference::root};

/// Each recipe, and the commands that it calls in their order.
const RECIPES: [(&str, &str); 6] = [
    ("compose.yaml", "replay-server learner actor actor status"),
    ("kubernetes.yaml", "replay-server learner actor"),
    ("driml.sbatch", "replay-server learner actor"),
    ("systemd/driml-replay-server.service", "replay-server"),
    ("systemd/driml-learner.service", "learner"),
    ("systemd/driml-actor@.service", "actor"),
];

const PLACEHOLDERS: [(&str, &str); 10] = [
    ("${DRIML_ENV:-procgen:coinrun}", "procgen:coinrun"),
    ("${DRIML_AGENT:-driml-ada}", "driml-ada"),
    ("${DRIML_FRAMES:-120000}", "120000"),
    ("$actors", "4"),
    ("$DRIML_SETTINGS", ""),
    ("\"$@\"", ""),
    ("\"${world[@]}\"", ""),
    ("%i", "7"),
    ("env:JOB_COMPLETION_INDEX", "3"),
    ("env:SLURM_PROCID", "3"),
];

fn read_recipe(name: &str) -> String {
    let path = root().join("deploy/package").join(name);
    fs::read_to_string(&path).unwrap_or_else(|e| panic!("{}: {e}", path.display()))
}

fn split_words(text: &str) -> Vec<String> {
    let plain = |word: &str| word.trim_matches(['"', ',', '\'', '[', ']']).to_owned();
    let words = text.split_whitespace().map(plain);
    words.filter(|word| !word.is_empty()).collect()
}

/// Returns the calls of the program in a recipe: lines of a shell or of systemd, or a YAML list in one line or with an item per line.
fn find_calls(text: &str) -> Vec<Vec<String>> {
    let lines = text.lines().map(str::trim);
    let mut lines = lines.filter(|line| !line.starts_with('#')).peekable();
    let mut found = Vec::new();
    while let Some(line) = lines.next() {
        let of_yaml = line.strip_prefix("command:");
        let of_yaml = of_yaml.or_else(|| line.strip_prefix("args:"));
        let of_slurm = || {
            let process = line.strip_prefix("process ")?;
            Some(process.split_once("\"$program\" ")?.1)
        };
        let of_systemd = || line.strip_prefix("ExecStart=/usr/local/bin/driml ");
        let Some(call) = of_yaml.or_else(of_slurm).or_else(of_systemd) else {
            continue;
        };
        let mut call = call.to_owned();
        while let Some(item) = lines.next_if(|line| of_yaml == Some("") && line.starts_with("- ")) {
            call += &item[1..];
        }
        for (holder, value) in PLACEHOLDERS {
            call = call.replace(holder, value);
        }
        found.push(split_words(&call));
    }
    found
}

#[test]
fn every_call_in_a_recipe_has_flags_that_the_program_knows() {
    for (name, expected) in RECIPES {
        let calls = find_calls(&read_recipe(name));
        let commands: Vec<_> = calls.iter().map(|words| words[0].as_str()).collect();
        assert_eq!(commands.join(" "), expected, "{name}");
        for words in calls {
            let call = ["driml".to_owned()].into_iter().chain(words);
            if let Err(e) = Cli::try_parse_from(call) {
                panic!("{name}: {e}");
            }
        }
    }
}

#[test]
fn the_batch_script_is_a_shell_s() {
    let script = read_recipe("driml.sbatch");
    let checked = Command::new("bash").args(["-n", "-c", &script]).output();
    let checked = checked.unwrap();
    assert!(checked.status.success(), "{checked:?}");
}

/// The files that the image installs and copies exist.
#[test]
fn the_image_is_made_of_what_is_there() {
    let file = read_recipe("Dockerfile");
    for copied in file.lines().filter_map(|line| line.strip_prefix("COPY ")) {
        let from = copied.split_whitespace().next().unwrap();
        if from != "--from=build" {
            assert!(root().join(from).exists(), "{copied}");
        }
    }
    let manifest = fs::read_to_string(root().join("Cargo.toml")).unwrap();
    assert!(file.contains("--profile dist") && manifest.contains("[profile.dist]"));
    let mut lines = manifest.lines();
    let rust = lines.find_map(|line| line.strip_prefix("rust-version = "));
    let rust = rust.unwrap().trim_matches('"');
    assert!(file.contains(&format!("rust:{rust}-")), "{rust}");
}
