//! What an actor or the learner says of itself every few seconds, and what a replay server then knows of all processes of the run, for
//! `driml status`: who is connected, what each does, who waits, and when each was last seen.
//! Nothing depends on it but what a person is told. Counts and rates are in `status`.

use serde::{Deserialize, Serialize};

use super::status::Waiting;
use crate::wire::{
    error::CodecError,
    keys::{Alive, ProcessName},
    message::no_payload,
};

/// Most bytes of the description of what a process does.
const DOING_MAX: usize = 80;
/// Bytes of a warning that is passed on.
const WARNING_MAX: usize = 400;
/// Processes whose last warning is passed on: those with the newest ones.
pub const WARNINGS_MAX: usize = 64;

/// One incarnation of a process, by the number that only it and the replay server know.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum Participant {
    /// Of an actor.
    Actor {
        /// The actor's number in the run.
        actor: u32,
        /// This life's.
        incarnation: u64,
    },
    /// Of a learner.
    Learner(u64),
}

impl Participant {
    /// How others see that it is connected.
    pub fn alive(self) -> Alive {
        match self {
            Self::Actor { actor, incarnation } => Alive::actor(actor, incarnation),
            Self::Learner(learner) => Alive::learner(learner),
        }
    }
}

/// What a process reports about itself.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Report {
    /// Whose it is.
    pub who: Participant,
    /// What it does, such as `plays`; at most 80 bytes.
    pub doing: String,
    /// For how long, seconds.
    pub since_s: f64,
    /// The last warning or error in its log.
    pub last_warning: Option<Warning>,
    /// Updates after which the run is finished: the learner has learned from every batch, and has saved.
    pub finished: Option<u64>,
}

/// A line of a process's log.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Warning {
    /// The line, cut to 400 bytes.
    pub text: String,
    /// Its age, seconds.
    pub age_s: f64,
}

impl Warning {
    /// One of this age, cut to what may be sent.
    pub fn new(text: &str, age_s: f64) -> Self {
        Self {
            text: cut(text, WARNING_MAX),
            age_s,
        }
    }
}

impl Report {
    /// Cut to what may be sent.
    pub fn new(who: Participant, doing: &str, since_s: f64, last_warning: Option<Warning>) -> Self {
        Self {
            who,
            doing: cut(doing, DOING_MAX),
            since_s,
            last_warning,
            finished: None,
        }
    }

    pub(super) fn checked(&self, payload: &[u8]) -> Result<(), CodecError> {
        let warning = self.last_warning.as_ref();
        let too_long = self.doing.len() > DOING_MAX
            || warning.is_some_and(|warning| warning.text.len() > WARNING_MAX);
        if too_long {
            return Err(CodecError::Header(format!(
                "a report of more than {DOING_MAX} bytes, or a warning of more than {WARNING_MAX}"
            )));
        }
        let times = [self.since_s, warning.map_or(0.0, |warning| warning.age_s)];
        if times.iter().any(|it| !it.is_finite() || *it < 0.0) {
            return Err(CodecError::Header(format!(
                "a report of {times:?} seconds ago"
            )));
        }
        no_payload(payload)
    }

    pub(super) fn actor(&self) -> Option<u32> {
        match self.who {
            Participant::Actor { actor, .. } => Some(actor),
            Participant::Learner(_) => None,
        }
    }
}

fn cut(text: &str, bytes_max: usize) -> String {
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
    /// Whether it is connected.
    pub connected: bool,
    /// Seconds for which it has been connected, or gone.
    pub since_s: f64,
    /// How often it has joined since this replay server started.
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn texts_are_cut_between_characters() {
        assert_eq!(cut("grün", 3), "gr");
        assert_eq!(cut("grün", 4), "grü");
        assert_eq!(cut("", 4), "");
    }
}
