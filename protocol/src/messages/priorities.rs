//! Priorities that the learner sends back to the replay servers that drew the rows.
//! The learner computes priorities; the replay server decides their effect on later draws.

use serde::{Deserialize, Serialize};

use crate::wire::{error::CodecError, message::check_no_payload};

/// The replay server and its incarnation that drew rows by priority. Other incarnations cannot interpret the transition numbers.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Origin {
    /// The replay server's shard number, from 0.
    pub shard: u32,
    /// The replay server's incarnation: a random number, drawn at each start of the process.
    pub incarnation: u64,
}

/// The priorities of the rows of one batch.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct PriorityUpdate {
    /// The sender's number, as in its [`LearnerJoin`](crate::LearnerJoin).
    pub learner: u64,
    /// Counts up. An update with a number not above this learner's last is a repetition and changes nothing.
    pub number: u64,
    /// The rows, grouped by origin. The learner sends all groups to every shard, which uses its own.
    pub parts: Vec<PriorityPart>,
}

/// Rows that one replay server drew.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct PriorityPart {
    /// The replay server that drew the rows.
    pub origin: Origin,
    /// The number of each row's transition, since the start of the replay.
    pub transitions: Vec<u64>,
    /// The priority of each row: its C51 loss before weighting, in nats, at least 0.
    pub priorities: Vec<f32>,
}

impl PriorityUpdate {
    /// Number of rows in all parts.
    pub fn rows(&self) -> usize {
        self.parts.iter().map(|part| part.transitions.len()).sum()
    }

    pub(super) fn check_payload(&self, payload: &[u8]) -> Result<(), CodecError> {
        check_no_payload(payload)?;
        for part in &self.parts {
            let (transitions, priorities) = (part.transitions.len(), part.priorities.len());
            let why = format_args!("{priorities} priorities of {transitions} transitions");
            CodecError::check(transitions == priorities, why)?;
            let good = |priority: &f32| priority.is_finite() && *priority >= 0.0;
            if let Some(at) = part.priorities.iter().position(|it| !good(it)) {
                return Err(CodecError::Header(format!(
                    "transition {} has the priority {}, which is not a number of at least 0",
                    part.transitions[at], part.priorities[at]
                )));
            }
        }
        Ok(())
    }
}
