//! Runs a whole system under test: a folder, its processes, a client, and a deadline on each wait.
//! The harness knows no single test, sleeps only between two checks of a condition, and leaves no process behind.
//! It panics with what it found if an answer is wrong or misses the deadline.

#![allow(
    clippy::unwrap_used,
    clippy::print_stdout,
    reason = "a harness fails by panicking in the test that uses it, and says there what it knows"
)]

mod certificates;
mod client;
mod network;
mod process;
pub mod python;
mod run_folder;
mod skipped;
mod system;
mod waiting;

pub use certificates::{Certificates, EXPIRED, FUTURE};
pub use client::{Client, check_nothing_lost, connect, listen, new_learner, quic_endpoint};
pub use network::Network;
pub use process::{Exit, Process, check_has};
pub use run_folder::{Outcome, RunFolder, Summary, Table};
pub use skipped::{print_line, skip, skipped_offline, succeeds};
pub use system::{RunningProcess, TestSystem};
pub use waiting::{in_parallel, wait_for, wait_until};
