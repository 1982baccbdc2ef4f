//! End-to-end tests: the program under test as its users run it, and the rules of the repository.
//! Each crate tests its own behaviour; these tests need several crates.

#![allow(clippy::unwrap_used, reason = "these are tests")]

mod by_hand;
mod circles;
mod cli;
mod closed_terminal;
mod disk_full;
mod durable;
mod evaluate;
mod experiments;
mod failures;
mod frozen;
mod leftovers;
mod limits;
mod local;
mod lockstep;
mod lost_messages;
mod many_processes;
mod numbered;
mod own_worlds;
mod pages;
mod panics;
mod parity;
mod prioritised;
mod procgen;
mod python;
mod recovering;
mod refusals;
mod repo_rules;
mod resume;
mod resume_fuzz;
mod several_machines;
mod small_shared_memory;
mod soak;
mod status;
mod successors;
mod synthetic;
mod tensorboard;
mod tiny_replay;
mod tls;
mod watch;
mod written_off;

use std::net::{Ipv4Addr, TcpListener};

use driml_tests::{Process, TestSystem};

/// Creates a system for the program that cargo has built for this test.
fn system() -> TestSystem {
    TestSystem::new(env!("CARGO_BIN_EXE_driml-under-test"))
}

/// As [`system`], over TLS; `None` without openssl.
fn tls_system() -> Option<TestSystem> {
    system().over_tls()
}

/// Returns an unused endpoint and its listener. The loopback address belongs to this process, so no other takes the port meanwhile.
fn listen_on_free_port() -> (String, TcpListener) {
    let [_, high, middle, low] = std::process::id().to_be_bytes();
    let listener = TcpListener::bind((Ipv4Addr::new(127, high, middle, low), 0)).unwrap();
    (format!("tcp/{}", listener.local_addr().unwrap()), listener)
}

/// The warm-up in transitions and the batch size of the preset `smoke`.
const WARMUP: u64 = 200;
const ROWS: u32 = 16;

/// A run on the chain that takes about a second: 540 updates of 16 rows, replay ratio 8.
///
/// 1280 frames are whole chunks of one or two actors (4 environments x 8 steps), and (1280 - 200) * 8 / 16 is whole.
const SHORT: &str = "--env chain --preset smoke --frames 1280 --set replay.replay_ratio=8";

/// Returns the flags of [`SHORT`] with another number of frames.
fn chain(frames: u64) -> String {
    format!("--env chain --preset smoke --frames {frames} --set replay.replay_ratio=8")
}

/// A run on the chain that is too long to finish: the test ends the run long before its last frame.
const LONG: &str = "--env chain --preset smoke --frames 100000000 --set replay.replay_ratio=8";

/// Actors wait for a reply for longer than the machine stalls, so that they send no chunk twice.
const PATIENT: &str = "--set actor.ack_timeout_ms=60000";

/// A network of one small layer. It computes an update on Pac-Man's enlarged frames in a seventh of the time that the preset's takes.
const SMALL_NETWORK: &str = "--set model.conv=[{out=8,kernel=8,stride=8}]";

/// The roles of a run's processes.
const PROCESSES: [&str; 3] = ["replay-server", "learner", "actor"];

/// Draws rows by priority, with the numbers of Rainbow.
const PRIORITISED: &str =
    "--set 'replay.sampling={rule=\"prioritised\",alpha=0.5,beta_start=0.4,beta_end=1.0}'";

/// Starts a run of `driml-ada` and waits until it has made more than `updates` updates.
fn start_run(system: &TestSystem, updates: u64) -> Process {
    start_run_with(system, "--agent driml-ada", updates)
}

/// Starts a run with these flags and waits until it has made more than `updates` updates.
fn start_run_with(system: &TestSystem, flags: &str, updates: u64) -> Process {
    let process = system.start(&system.local_args(&format!("{LONG} {flags}")));
    system.connect().wait_for_updates(updates);
    process
}
