//! The action-affinity matrix A, which the learner sends to the replay server.
//! The learner estimates A elsewhere.

use serde::{Deserialize, Serialize};

use crate::wire::error::CodecError;

/// The matrix A, row by row: `matrix[i * n + j]` is the softmax over j of q(a_i, a_j); rows sum to 1.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct AffinityUpdate {
    /// The sender's number, as in its [`LearnerJoin`](crate::LearnerJoin).
    pub learner: u64,
    /// Counts up from 1. The replay server ignores a version older than this learner's newest.
    pub version: u64,
    /// The probabilities [n, n] of the n raw actions of the world.
    pub matrix: Vec<f32>,
}

impl AffinityUpdate {
    /// Checks the size and that every entry is a probability.
    pub fn validate(&self, num_actions: u32) -> Result<(), CodecError> {
        let (n, len) = (num_actions as usize, self.matrix.len());
        let why =
            format_args!("an affinity with {len} entries; this run has {num_actions} actions");
        CodecError::check(len == n * n, why)?;
        match self.matrix.iter().position(|p| !(0.0..=1.0).contains(p)) {
            Some(at) => Err(CodecError::Header(format!(
                "entry ({}, {}) of the affinity is {}, not a probability",
                at / n,
                at % n,
                self.matrix[at]
            ))),
            None => Ok(()),
        }
    }
}
