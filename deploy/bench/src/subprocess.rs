//! Starts this program as another process: a replay server, a whole run, or itself with another number of threads.
//! `server` and `system` send requests to these processes.

use std::path::Path;

use anyhow::Context;
use driml_launch::{
    console::Screen,
    endpoint::wait_until_listening,
    managed_process::{ManagedProcess, THREADS_VARIABLE, program_command},
};
use driml_machine::process_env;
use driml_protocol::Shutdown;

use crate::settings;

/// Makes sure that this process has `threads` threads for arithmetic, as the launcher gives those of a run. If not, re-executes the program
/// in the same process with the same arguments.
pub(super) fn ensure_threads(threads: u32) -> anyhow::Result<()> {
    let threads = threads.to_string();
    if std::env::var(THREADS_VARIABLE).is_ok_and(|it| it == threads) {
        return Ok(());
    }
    let again = process_env::restart_with([(THREADS_VARIABLE, threads.as_str())]);
    again.context("starting this program again with other threads")
}

/// Starts this program with `args` for driml-ada on bigfish, with the preset `paper`, the settings `sets` and its log in `folder`. Waits
/// until it listens at `endpoint`. Dropping the result ends the process.
pub(super) fn start(
    name: &str,
    args: &[&str],
    endpoint: &str,
    sets: &[&str],
    folder: &Path,
) -> anyhow::Result<ManagedProcess> {
    let (world, agent) = (settings::WORLD, settings::AGENT);
    let run = ["--env", world, "--agent", agent, "--preset", "paper"];
    let sets: Vec<_> = sets.iter().flat_map(|&set| ["--set", set]).collect();
    let args = [args, &["--listen", endpoint], &run, &sets].concat();
    let command = program_command(&args, 1);
    let mut process = ManagedProcess::start(name, command, folder, &Screen::default())?;
    // A benchmark does not listen for signals.
    wait_until_listening(endpoint, &Shutdown::default(), || process.check_alive())?;
    Ok(process)
}
