//! `driml doctor` on whatever machine runs these tests.
//! How each fact is judged is tested beside it.

use crate::system;

#[test]
fn the_doctor_names_what_the_machine_has_and_ends_as_it_says() {
    let ended = system().run("doctor");
    for what in [
        "cores",
        "vectors",
        "memory",
        "shared memory",
        "locked memory",
        "disk",
        "Procgen",
        "cuda",
    ] {
        let states = ["ok", "note", "missing"].map(|state| format!("{state:<8} {what}"));
        assert!(
            ended
                .stdout
                .lines()
                .any(|line| states.iter().any(|state| line.starts_with(state))),
            "no line about {what} in\n{}",
            ended.stdout
        );
    }
    // Without a network Procgen's engine may be missing.
    let trains = ended.stdout.contains("This machine can train on the CPU");
    ended.expect_code(i32::from(!trains));
}

#[test]
fn the_facts_are_there_as_json_too() {
    let ended = system().run("doctor --json");
    let facts = ended.json();
    let facts = facts.as_array().unwrap();
    assert!(facts.len() >= 8, "{}", ended.stdout);
    assert_eq!(facts[0]["what"], "cores");
    assert!(facts.iter().all(|fact| fact["state"].is_string()));
}
