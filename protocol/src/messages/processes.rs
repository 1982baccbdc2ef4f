//! The processes of a run and their state, as a replay server knows them, for `driml status`.
//! Counts and rates are in `status`; here are who is connected, who waits, and when each was last seen.

use serde::{Deserialize, Serialize};

use super::{report::Warning, status::Waiting};
use crate::wire::keys::ProcessName;

/// Processes whose last warning is passed on: those with the newest ones.
pub const WARNINGS_MAX: usize = 64;

/// What a replay server knows of one process.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ProcessStatus {
    /// The learner, or an actor by its number.
    pub who: ProcessName,
    /// Whether it is connected.
    pub connected: bool,
    /// Seconds for which it has been connected, or gone.
    pub since_s: f64,
    /// How often it has joined the run.
    pub lives: u32,
    /// Seconds since its last chunk, or request for a batch; none before the first.
    pub last_seen_s: Option<f64>,
    /// Seconds for which its chunk, or request, has been waiting at the rate limiter; none if none waits.
    pub held_s: Option<f64>,
    /// An actor's: the version of the weights that acted in its last chunk.
    pub weights_version: Option<u64>,
    /// What it says that it does, for how many seconds, and how many seconds ago it said so; none if it has said nothing.
    pub doing: Option<(String, f64, f64)>,
    /// The last warning in its log, where it is among the newest of all processes.
    pub last_warning: Option<Warning>,
}

/// How the log stands in which a replay server keeps its replay on disk.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct LogStatus {
    /// The folder, on the replay server's machine.
    pub folder: String,
    /// Bytes on disk.
    pub bytes: u64,
    /// Most that they may become; none if the replay's capacity alone limits them.
    pub bytes_max: Option<u64>,
    /// Seconds since a flush began that succeeded: a power cut takes what was written since.
    pub flushed_s: f64,
    /// For how many seconds the disk has been refusing what is to be written, and what it says; none if it takes it.
    pub refused: Option<(f64, String)>,
    /// Bytes of what has happened and could not be written: lost if the process dies now. No transitions are among them.
    pub unwritten_bytes: u64,
}

/// A replay server's report on itself and on all processes that have joined it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ProcessesStatus {
    /// Seconds since it started.
    pub up_s: f64,
    /// Who waits at the rate limiter now.
    pub waiting: Waiting,
    /// For how many seconds.
    pub waiting_s: f64,
    /// Requests for a batch that wait.
    pub requests_waiting: u32,
    /// Chunks that wait.
    pub chunks_waiting: u32,
    /// Their bytes in memory.
    pub chunk_bytes_waiting: u64,
    /// Version of the newest weights; 0 before the first.
    pub weights_version: u64,
    /// Their age, seconds; none before the first.
    pub weights_age_s: Option<f64>,
    /// The log on disk; none if the replay is in memory alone.
    pub log: Option<LogStatus>,
    /// The last warning in the replay server's own log.
    pub last_warning: Option<Warning>,
    /// The learner, then the actors by number.
    pub processes: Vec<ProcessStatus>,
}
