//! What an actor or the learner says of itself every few seconds: what it does and the last thing it warned of.
//! Nothing depends on it but what a person is told.

use serde::{Deserialize, Serialize};

use crate::wire::{error::CodecError, keys::Alive, message::no_payload};

/// Most bytes of the description of what a process does.
const DOING_MAX: usize = 80;
/// Bytes of a warning that is passed on.
const WARNING_MAX: usize = 400;

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
