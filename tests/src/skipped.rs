//! Reports tests that are skipped because something is missing, each by name.
//! This module checks only commands and the environment.

use std::{io::Write, process::Command, thread};

/// Reports on stderr that the test of this thread is skipped, and why.
///
/// Does not use `eprintln!`, because the test runner hides its output when a test passes.
pub fn skip(why: &str) {
    let test = thread::current();
    let name = test.name().unwrap_or("a test");
    print_line(&format!("skipped: {name} ({why})"));
}

/// Returns whether a command that a test needs succeeds. If not, reports the test as skipped; the caller must then return.
pub fn succeeds(command: &mut Command) -> bool {
    let why = match command.output() {
        Ok(output) if output.status.success() => return true,
        Ok(output) => String::from_utf8_lossy(&output.stderr).trim().to_owned(),
        Err(e) => format!("{}: {e}", command.get_program().display()),
    };
    skip(&why);
    false
}

/// Writes a line to stderr that the test runner does not capture.
pub fn print_line(line: &str) {
    std::io::stderr()
        .write_all(format!("{line}\n").as_bytes())
        .expect("stderr is there while tests run");
}

/// Returns whether `DRIML_OFFLINE` skips a test that may have to download Procgen's engine. If so, reports the test as skipped.
pub fn skipped_offline() -> bool {
    let offline = std::env::var_os("DRIML_OFFLINE");
    let is_offline = offline.is_some_and(|value| !value.is_empty() && value != "0");
    if is_offline {
        skip("DRIML_OFFLINE=1");
    }
    is_offline
}
