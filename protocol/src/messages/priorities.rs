//! Priorities on their way from the learner back to the replay servers that drew the rows.
//! What a priority is made of is the learner's business, what it does to later draws the replay server's.

use serde::{Deserialize, Serialize};

use crate::wire::{error::CodecError, message::no_payload};

/// Which life of which replay server drew rows by priority: their numbers mean nothing to another one.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Origin {
    /// Which of the run's replay shards drew them, from 0.
    pub shard: u32,
    /// A number that a replay server has for as long as it runs.
    pub incarnation: u64,
}

/// What the learner found of the rows of one batch.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct PriorityUpdate {
    /// Which learner sends it: that of its [`LearnerJoin`](crate::LearnerJoin).
    pub learner: u64,
    /// Counts up; one that is not above this learner's last is a repetition, and changes nothing.
    pub number: u64,
    /// The rows, by where they come from. Every shard is sent all, and takes its own.
    pub parts: Vec<PriorityPart>,
}

/// Rows that one replay server drew.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct PriorityPart {
    /// Who drew them.
    pub origin: Origin,
    /// The transition of each row, by its number since the start of the replay.
    pub transitions: Vec<u64>,
    /// Its priority: the row's C51 loss before any weight, in nats, from 0 on.
    pub priorities: Vec<f32>,
}

impl PriorityUpdate {
    /// Rows of all parts.
    pub fn rows(&self) -> usize {
        self.parts.iter().map(|part| part.transitions.len()).sum()
    }

    pub(super) fn checked(&self, payload: &[u8]) -> Result<(), CodecError> {
        no_payload(payload)?;
        for part in &self.parts {
            let (transitions, priorities) = (part.transitions.len(), part.priorities.len());
            if transitions != priorities {
                return Err(CodecError::Header(format!(
                    "{priorities} priorities of {transitions} transitions"
                )));
            }
            let good = |priority: &f32| priority.is_finite() && *priority >= 0.0;
            if let Some(at) = part.priorities.iter().position(|it| !good(it)) {
                return Err(CodecError::Header(format!(
                    "transition {} has the priority {}, which is not a number from 0 on",
                    part.transitions[at], part.priorities[at]
                )));
            }
        }
        Ok(())
    }
}
