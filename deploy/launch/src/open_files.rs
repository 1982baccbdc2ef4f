//! How many open files the processes of a run need, so that one that cannot have them is not started. It opens none.
//!
//! Measured on runs of 1, 4 and 12 actors: a replay server has 40 and 4 for each actor (2 where none shares memory), the launcher 40 and 3
//! for each process, the others 33.

use driml_machine::error::Usage;
use driml_settings::config::RunConfig;
use nix::sys::resource::{Resource, getrlimit, setrlimit};

/// Of each process, and some for what it opens for a moment.
const BASE: u64 = 48;
/// Of the launcher for each process: the ends of two pipes, and a log.
const OF_LAUNCHER: u64 = 3;

/// Of a replay server for so many actors: a socket and a segment of zenoh's for each, and what an actor sends in.
fn of_server(actors: u64, shared_memory: bool) -> u64 {
    BASE + actors * if shared_memory { 4 } else { 2 }
}

/// Whether this process, or one that it starts, may have so many open files. What may be raised is.
fn check(needed: u64, whose: &str) -> Result<(), String> {
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

/// Checks that the launcher and its replay servers may open as many files as the run's actors take.
pub(crate) fn check_run(config: &RunConfig) -> Result<(), Usage> {
    let actors = u64::from(config.local.actors);
    let shards = u64::from(config.replay.shards);
    let of_launcher = BASE + OF_LAUNCHER * (actors + shards + 1);
    let of_server = of_server(actors.div_ceil(shards), config.transport.shared_memory);
    let (needed, whose) = match of_server > of_launcher {
        true => (of_server, "the replay server"),
        false => (of_launcher, "the launcher"),
    };
    check(needed, &format!("{whose} of a run with {actors} actors")).map_err(Usage)
}

/// Warns if a replay server that is started by hand may not open as many files as the actors take that its settings know of.
pub fn warn_of_server(config: &RunConfig) {
    let actors = u64::from(config.local.actors);
    let needed = of_server(actors, config.transport.shared_memory);
    if let Err(why) = check(needed, &format!("a replay server for {actors} actors")) {
        tracing::warn!("{why}");
    }
}
