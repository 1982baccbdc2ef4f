//! A whole system under test: a folder, processes, a client, and a deadline on each wait.
//! It knows nothing of any one test, sleeps only between two looks at a condition, and leaves no process behind.

#![allow(
    clippy::unwrap_used,
    clippy::print_stdout,
    reason = "a harness fails by panicking in the test that uses it, and says there what it knows"
)]

mod certificates;
mod client;
mod network;
mod process;
mod run_folder;
mod system;
mod waiting;

pub use certificates::{Certificates, Valid, skipped_without_openssl};
pub use client::Client;
pub use network::Network;
pub use process::{Ended, Process};
pub use run_folder::{RunFolder, Summary};
pub use system::{Survivor, TestSystem};
pub use waiting::{DEADLINE, wait_for};

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
