//! `driml evaluate --record`: films of what is played, and those that cannot be made.
//! What an evaluation prints is in `evaluate`.

use std::fs;

use crate::{evaluate::with_run, system};

#[test]
fn a_film_changes_nothing_that_is_played() {
    let system = system();
    system
        .run_ok("local --lockstep --env mspacman --agent driml-ada --preset smoke --frames 320 --run-dir run");
    let plain = system.run_ok("evaluate run --episodes 3");
    let film =
        "evaluate run --episodes 3 --record play.gif --overlay --record-steps 40 --record-envs 2";
    let filmed = system.run_ok(film);
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
    system.run_ok(film);
    let again = fs::read(system.path("play.gif")).unwrap();
    assert!(bytes == again, "the same play is the same film");
    assert!(!system.path("play.gif.tmp").exists());
}

#[test]
fn films_that_cannot_be_are_refused_before_anything_is_played() {
    let system = with_run();
    system.refuses_each(
        "
        evaluate run --record play.mp4 => use one that ends in .gif
        evaluate run --record none/play.gif => --record none/play.gif: No such file or directory
        evaluate run --overlay => --record <FILE.gif>
        evaluate run --record play.gif --record-steps 0 => 0 is not in 1..=10000
        ",
    );
    fs::remove_dir_all(system.path("run/checkpoints")).unwrap();
    system.refuses("evaluate run --record play.gif", "has no checkpoint yet");
    assert!(!system.names(".").iter().any(|name| name.contains("play")));
}
