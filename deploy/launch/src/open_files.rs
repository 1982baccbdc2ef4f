//! How many open files the processes of a run need, checked before a process starts. This module opens none.
//!
//! Measured on runs of 1, 4 and 12 actors: a replay server has 40 open files and 4 per actor (2 without shared memory), the launcher
//! 40 and 3 per process, each other process 33.

use driml_machine::{error::Usage, units::count};
use driml_settings::config::RunConfig;
use nix::sys::resource::{Resource, getrlimit, setrlimit};

/// Open files of each process, with some room for files that are open only briefly.
const BASE_FILES: u64 = 48;
/// Additional open files of the launcher per process: the ends of two pipes, and a log.
const LAUNCHER_FILES_PER_PROCESS: u64 = 3;

/// Open files of a replay server for this many actors: per actor a socket, a segment of zenoh's, and the memory in which it sends.
fn server_files(actors: u64, shared_memory: bool) -> u64 {
    BASE_FILES + actors * if shared_memory { 4 } else { 2 }
}

/// Checks that this process, or a child of it, may have `needed` open files. Raises the soft limit to the hard limit.
fn check_limit(needed: u64, whose: &str) -> Result<(), String> {
    let max = match getrlimit(Resource::RLIMIT_NOFILE) {
        Ok((_, hard)) if setrlimit(Resource::RLIMIT_NOFILE, hard, hard).is_ok() => hard,
        Ok((soft, _)) => soft,
        Err(_) => u64::MAX,
    };
    if needed <= max {
        return Ok(());
    }
    Err(format!(
        "{whose} needs {needed} open files, and the system allows {max}: raise the limit (`ulimit -Hn`; a service needs \
         LimitNOFILE={needed}, a container --ulimit nofile={needed}), or use fewer actors"
    ))
}

/// Checks that the launcher and its replay servers may open as many files as the run's actors need.
pub(crate) fn check_run(config: &RunConfig) -> Result<(), Usage> {
    let actors = u64::from(config.local.actors);
    let shards = u64::from(config.replay.shards);
    let launcher_files = BASE_FILES + LAUNCHER_FILES_PER_PROCESS * (actors + shards + 1);
    let server_files = server_files(actors.div_ceil(shards), config.transport.shared_memory);
    let (needed, whose) = match server_files > launcher_files {
        true => (server_files, "the replay server"),
        false => (launcher_files, "the launcher"),
    };
    let whose = format!("{whose} of a run with {}", count(actors, "actor"));
    check_limit(needed, &whose).map_err(Usage)
}

/// Warns if a replay server that is started by hand may not open as many files as the actors in its settings need.
pub fn warn_if_limit_low(config: &RunConfig) {
    let actors = u64::from(config.local.actors);
    let needed = server_files(actors, config.transport.shared_memory);
    let whose = format!("a replay server for {}", count(actors, "actor"));
    if let Err(why) = check_limit(needed, &whose) {
        tracing::warn!("{why}");
    }
}
