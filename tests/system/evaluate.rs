//! `driml evaluate`: what it prints, and what it says of folders and checkpoints that cannot be used.
//! Whether an agent has learned is in `lockstep`.

use std::fs;

use driml_tests::TestSystem;

use crate::{SHORT, system};

/// A system with a run in `run`.
fn with_run() -> TestSystem {
    let system = system();
    system
        .run(&format!(
            "local --lockstep --agent driml-fix {SHORT} --run-dir run"
        ))
        .expect_code(0);
    system
}

#[test]
fn it_prints_the_agent_beside_a_random_policy() {
    let system = with_run();
    let ended = system
        .run("evaluate --run run --episodes 7 --seed 2")
        .expect_code(0);
    let lines: Vec<_> = ended.stdout.lines().collect();
    assert_eq!(lines.len(), 3, "{lines:?}");
    assert_eq!(
        lines[0],
        "chain as trained on, 7 episodes each, weights after 540 updates, seed 2"
    );
    for (line, policy) in lines[1..].iter().zip(["driml-fix", "random"]) {
        assert!(
            line.starts_with(policy) && line.contains("standard deviation"),
            "{line}"
        );
    }
    let again = system
        .run("evaluate --run run --episodes 7 --seed 2")
        .expect_code(0);
    assert_eq!(
        ended.stdout, again.stdout,
        "the same seed plays the same episodes"
    );
    // The chain has no levels to hold back.
    system
        .run("evaluate --run run --levels unseen")
        .expect_code(64)
        .expect_said("use --levels train");
}

#[test]
fn a_folder_that_is_no_run_s() {
    let system = system();
    fs::create_dir(system.path("empty")).unwrap();
    for folder in ["empty", "none"] {
        let ended = system
            .run(&format!("evaluate --run {folder}"))
            .expect_code(64);
        assert!(
            ended
                .stderr
                .starts_with(&format!("error: {folder} is not the folder of a run")),
            "{}",
            ended.stderr
        );
    }
    fs::write(system.path("empty/config.toml"), "[run]\n").unwrap();
    system
        .run("evaluate --run empty")
        .expect_code(64)
        .expect_said("config.toml that driml wrote");
}

#[test]
fn a_damaged_checkpoint_is_named_and_not_used() {
    let system = with_run();
    let newest = system.run_folder("run").checkpoints().pop().unwrap();
    let name = newest.file_name().unwrap().to_str().unwrap();
    for file in [
        "online.safetensors",
        "target.safetensors",
        "optimizer.safetensors",
        "state.json",
    ] {
        let path = newest.join(file);
        let whole = fs::read(&path).unwrap();
        for broken in [&whole[..whole.len() / 2], &whole[..0], &flipped(&whole)] {
            fs::write(&path, broken).unwrap();
            let ended = system.run("evaluate --run run --episodes 1").expect_code(1);
            let said = ended.stderr.lines().last().unwrap();
            assert!(
                said.starts_with(&format!(
                    "error: run/checkpoints/{name}/{file} is damaged: "
                )),
                "{said}"
            );
            assert!(said.contains("remove the folder it is in"), "{said}");
        }
        fs::remove_file(&path).unwrap();
        system
            .run("evaluate --run run --episodes 1")
            .expect_code(1)
            .expect_said(&format!("{file} is damaged: it is missing"));
        fs::write(&path, &whole).unwrap();
    }
    system.run("evaluate --run run --episodes 1").expect_code(0);
}

fn flipped(bytes: &[u8]) -> Vec<u8> {
    let mut bytes = bytes.to_vec();
    let at = bytes.len() * 3 / 4;
    bytes[at] ^= 1;
    bytes
}

#[test]
fn weights_of_another_run_are_refused() {
    let system = with_run();
    let config = system.path("run/config.toml");
    let text = fs::read_to_string(&config).unwrap();
    fs::write(&config, text.replace("seed = 1", "seed = 2")).unwrap();
    system
        .run("evaluate --run run")
        .expect_code(1)
        .expect_said("belongs to a run with specification")
        .expect_said("resume with the settings it was made with");
    fs::remove_dir_all(system.path("run/checkpoints")).unwrap();
    system
        .run("evaluate --run run")
        .expect_code(64)
        .expect_said("has no checkpoint yet");
}

#[test]
fn a_film_changes_nothing_that_is_played() {
    let system = system();
    system
        .run("local --lockstep --env mspacman --agent driml-ada --preset smoke --frames 320 --run-dir run")
        .expect_code(0);
    let plain = system.run("evaluate run --episodes 3").expect_code(0);
    let film =
        "evaluate run --episodes 3 --record play.gif --overlay --record-steps 40 --record-copies 2";
    let filmed = system.run(film).expect_code(0);
    let said: Vec<_> = filmed.stdout.lines().collect();
    assert_eq!(said[1], "filmed 40 steps: play.gif");
    let rest: Vec<_> = said
        .iter()
        .filter(|line| !line.starts_with("filmed"))
        .copied()
        .collect();
    assert_eq!(rest, plain.stdout.lines().collect::<Vec<_>>());
    let bytes = fs::read(system.path("play.gif")).unwrap();
    assert!(bytes.starts_with(b"GIF89a") && bytes.ends_with(b";"));
    system.run(film).expect_code(0);
    let again = fs::read(system.path("play.gif")).unwrap();
    assert!(bytes == again, "the same play is the same film");
    assert!(!system.path("play.gif.tmp").exists());
}

#[test]
fn films_that_cannot_be_are_refused_before_anything_is_played() {
    let system = with_run();
    for (flags, said) in [
        ("--record play.mp4", "take one that ends in .gif"),
        (
            "--record none/play.gif",
            "--record none/play.gif: No such file or directory",
        ),
        ("--overlay", "--record <FILE.gif>"),
        (
            "--record play.gif --record-steps 0",
            "0 is not in 1..=10000",
        ),
    ] {
        let ended = system.run(&format!("evaluate run {flags}")).expect_code(64);
        ended.expect_said(said);
    }
    fs::remove_dir_all(system.path("run/checkpoints")).unwrap();
    system
        .run("evaluate run --record play.gif")
        .expect_code(64)
        .expect_said("has no checkpoint yet");
    let left = fs::read_dir(system.path(".")).unwrap();
    let left = left.filter(|it| {
        it.as_ref()
            .unwrap()
            .file_name()
            .to_string_lossy()
            .contains("play")
    });
    assert_eq!(left.count(), 0);
}
