//! `driml doctor` on whatever machine runs these tests.
//! The judgement of each fact is tested beside its code.

use crate::system;

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
