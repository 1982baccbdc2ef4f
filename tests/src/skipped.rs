//! Tests that are skipped for want of something, each by name.
//! It looks for nothing but what the environment says.

use std::{io::Write, process::Command, thread};

/// Says on stderr that the test of this thread is skipped, and why.
///
/// The line does not go through `eprintln!`, whose output the test runner keeps to itself when a test passes.
pub fn skip(why: &str) {
    let test = thread::current();
    let name = test.name().unwrap_or("a test");
    note(&format!("skipped: {name} ({why})"));
}

/// Whether a command that a test needs succeeds; else the test is to be skipped, and a line on stderr names it.
pub fn succeeds(command: &mut Command) -> bool {
    let why = match command.output() {
        Ok(output) if output.status.success() => return true,
        Ok(output) => String::from_utf8_lossy(&output.stderr).trim().to_owned(),
        Err(e) => format!("{}: {e}", command.get_program().display()),
    };
    skip(&why);
    false
}

/// Says a line on stderr, past the test runner.
pub fn note(line: &str) {
    std::io::stderr()
        .write_all(format!("{line}\n").as_bytes())
        .expect("stderr is there while tests run");
}

/// Whether a test that needs Procgen's engine, which may have to be fetched, is to be skipped; a line on stderr then names it.
pub fn skipped_offline() -> bool {
    let offline = std::env::var_os("DRIML_OFFLINE");
    let is_offline = offline.is_some_and(|value| !value.is_empty() && value != "0");
    if is_offline {
        skip("DRIML_OFFLINE=1");
    }
    is_offline
}
