//! Tests that are skipped for want of something, each by name.
//! It looks for nothing but what the environment says.

use std::io::Write;

/// Says on stderr that `test` is skipped, and why.
///
/// The line does not go through `eprintln!`, whose output the test runner keeps to itself when a test passes.
pub fn skip(test: &str, why: &str) {
    note(&format!("skipped: {test} ({why})"));
}

/// Says a line on stderr, past the test runner.
pub fn note(line: &str) {
    std::io::stderr()
        .write_all(format!("{line}\n").as_bytes())
        .expect("stderr is there while tests run");
}

/// Whether `test`, which needs Procgen's engine, is to be skipped; a line on stderr then names it.
pub fn skipped_offline(test: &str) -> bool {
    let offline =
        std::env::var_os("DRIML_OFFLINE").is_some_and(|value| !value.is_empty() && value != "0");
    if offline {
        skip(test, "DRIML_OFFLINE=1");
    }
    offline
}
