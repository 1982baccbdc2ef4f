//! The reports that an actor or the learner sends every few seconds, and what a replay server knows of all processes of the run, for
//! `driml status`: which are connected, what each does, which wait, and when each was last seen.
//! This data is only shown to the user. Counts and rates are in `status`.

use serde::{Deserialize, Serialize};

use super::{join::ActorJoin, status::Waiting};
use crate::wire::{
    error::CodecError,
    keys::{Peer, ProcessName},
    message::check_no_payload,
};

/// Most bytes of the description of what a process does.
const DOING_BYTES_MAX: usize = 80;
const WARNING_BYTES_MAX: usize = 400;
/// Most processes whose last warning is in a status: those with the newest warnings.
pub const WARNINGS_MAX: usize = 64;

/// One incarnation of a process, by a number that only this process and the replay server know.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum Participant {
    /// An actor, as it joined.
    Actor(ActorJoin),
    /// A learner, by its number.
    Learner(u64),
}

impl Participant {
    /// The process as other processes see it by its liveliness token.
    pub fn peer(self) -> Peer {
        match self {
            Self::Actor(join) => Peer::actor(join.actor, join.incarnation),
            Self::Learner(learner) => Peer::learner(learner),
        }
    }
}

/// What a process reports about itself.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Report {
    /// The process that reports.
    pub who: Participant,
    /// What the process does, such as `plays`; at most 80 bytes.
    pub doing: String,
    /// Seconds since the process began to do this.
    pub since_s: f64,
    /// The last warning or error in the process's log.
    pub last_warning: Option<Warning>,
    /// Updates after which the run was finished; `None` before the learner has learned from every batch and has saved.
    pub finished: Option<u64>,
}

/// A warning or an error in a process's log.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Warning {
    /// The line, cut to 400 bytes.
    pub text: String,
    /// The warning's age, seconds.
    pub age_s: f64,
}

impl Warning {
    /// Creates a warning whose text is cut to 400 bytes.
    pub fn new(text: &str, age_s: f64) -> Self {
        Self {
            text: truncate(text, WARNING_BYTES_MAX),
            age_s,
        }
    }
}

impl Report {
    /// Creates a report whose `doing` is cut to 80 bytes.
    pub fn new(who: Participant, doing: &str, since_s: f64, last_warning: Option<Warning>) -> Self {
        Self {
            who,
            doing: truncate(doing, DOING_BYTES_MAX),
            since_s,
            last_warning,
            finished: None,
        }
    }

    pub(super) fn check_payload(&self, payload: &[u8]) -> Result<(), CodecError> {
        let warning = self.last_warning.as_ref();
        let are_short = self.doing.len() <= DOING_BYTES_MAX
            && warning.is_none_or(|warning| warning.text.len() <= WARNING_BYTES_MAX);
        let why = format_args!(
            "a report of more than {DOING_BYTES_MAX} bytes, or a warning of more than {WARNING_BYTES_MAX}"
        );
        CodecError::check(are_short, why)?;
        let times = [self.since_s, warning.map_or(0.0, |warning| warning.age_s)];
        let are_possible = times.iter().all(|it| it.is_finite() && *it >= 0.0);
        let why = format_args!("the report gives {times:?} s, which are not possible times");
        CodecError::check(are_possible, why)?;
        check_no_payload(payload)
    }

    pub(super) fn actor(&self) -> Option<u32> {
        match self.who {
            Participant::Actor(join) => Some(join.actor),
            Participant::Learner(_) => None,
        }
    }
}

fn truncate(text: &str, bytes_max: usize) -> String {
    let mut end = text.len().min(bytes_max);
    while !text.is_char_boundary(end) {
        end -= 1;
    }
    text[..end].to_owned()
}

/// What a replay server knows of one process.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ProcessStatus {
    /// The learner, or an actor by its number.
    pub who: ProcessName,
    /// Whether the process is connected.
    pub connected: bool,
    /// Seconds since the process connected or disconnected.
    pub since_s: f64,
    /// How often the process has joined since this replay server started.
    pub lives: u32,
    /// Seconds since the process's last chunk or request for a batch; `None` before the first.
    pub last_seen_s: Option<f64>,
    /// Seconds for which its chunk or request has been waiting at the rate limiter; `None` if none waits.
    pub held_s: Option<f64>,
    /// For an actor: the version of the weights that chose the actions of its last chunk.
    pub weights_version: Option<u64>,
    /// The reported activity, its duration in seconds, and the age of the report in seconds; `None` before the first report.
    pub doing: Option<(String, f64, f64)>,
    /// The last warning in the process's log, if it is among the newest of all processes.
    pub last_warning: Option<Warning>,
}

/// The state of the log in which a replay server keeps its replay on disk.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct LogStatus {
    /// The folder, on the replay server's machine.
    pub folder: String,
    /// Bytes on disk.
    pub bytes: u64,
    /// Limit of `bytes`; `None` if only the replay's capacity limits it.
    pub bytes_max: Option<u64>,
    /// Seconds since the start of the last successful flush. A power failure loses what was written since.
    pub flushed_s: f64,
    /// Seconds for which writes to the disk have failed, and the error; `None` if writes succeed.
    pub refused: Option<(f64, String)>,
    /// Bytes of events that could not be written, which are lost if the process dies now. They contain no transitions.
    pub unwritten_bytes: u64,
}

/// A replay server's report on itself and on all processes that have joined it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ProcessesStatus {
    /// Seconds since the replay server started.
    pub up_s: f64,
    /// Which side waits at the rate limiter now.
    pub waiting: Waiting,
    /// Seconds for which it has been waiting.
    pub waiting_s: f64,
    /// Number of requests for a batch that wait.
    pub requests_waiting: u32,
    /// Number of chunks that wait.
    pub chunks_waiting: u32,
    /// Bytes of memory that the waiting chunks take.
    pub chunk_bytes_waiting: u64,
    /// Version of the newest weights; 0 before the first.
    pub weights_version: u64,
    /// Seconds since the newest weights arrived; `None` before the first.
    pub weights_age_s: Option<f64>,
    /// The log on disk; none if the replay is in memory alone.
    pub log: Option<LogStatus>,
    /// The last warning in the replay server's own log.
    pub last_warning: Option<Warning>,
    /// The learner, then the actors by number, without those that have left.
    pub processes: Vec<ProcessStatus>,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn texts_are_cut_between_characters() {
        assert_eq!(truncate("grün", 3), "gr");
        assert_eq!(truncate("grün", 4), "grü");
        assert_eq!(truncate("", 4), "");
    }
}
