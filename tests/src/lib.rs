//! A whole system under test: a folder, processes, a client, and a deadline on each wait.
//! It knows nothing of any one test, sleeps only between two looks at a condition, and leaves no process behind.

#![allow(
    clippy::unwrap_used,
    clippy::print_stdout,
    reason = "a harness fails by panicking in the test that uses it, and says there what it knows"
)]

mod client;
mod process;
mod run_folder;
mod system;

pub use client::Client;
pub use process::{Ended, Process};
pub use run_folder::{RunFolder, Summary};
pub use system::{Survivor, TestSystem};

use std::{
    io::Write,
    thread,
    time::{Duration, Instant},
};

/// How long any one wait may take. Far more than a busy machine of two cores needs, and short of a CI job's limit.
pub const DEADLINE: Duration = Duration::from_secs(180);
/// Between two looks at a condition.
const LOOK_AGAIN: Duration = Duration::from_millis(10);

/// Waits until `look` gives something.
///
/// # Panics
/// At the [`DEADLINE`], saying what was waited for.
pub fn wait_for<T>(what: &str, mut look: impl FnMut() -> Option<T>) -> T {
    let started = Instant::now();
    loop {
        if let Some(seen) = look() {
            return seen;
        }
        assert!(
            started.elapsed() < DEADLINE,
            "waited {DEADLINE:?} for: {what}"
        );
        thread::sleep(LOOK_AGAIN);
    }
}

/// Says on stderr that `test` is skipped, and why.
///
/// The line does not go through `eprintln!`, whose output the test runner keeps to itself when a test passes.
pub fn skip(test: &str, why: &str) {
    let line = format!("skipped: {test} ({why})\n");
    std::io::stderr()
        .write_all(line.as_bytes())
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
