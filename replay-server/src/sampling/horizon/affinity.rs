//! The action affinity that the adaptive rule uses: the newest matrix that the learner sent.
//! Only the learner estimates the matrix.

use driml_protocol::{AffinityUpdate, CodecError};
use serde::{Deserialize, Serialize};

/// A[i, j]: how strongly action j is expected after action i; rows are softmaxes.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Affinity {
    version: u64,
    /// Whether to take the next matrix whatever its version, as it comes from another learner, which may start from an earlier update.
    pub(crate) from_another: bool,
    num_actions: u32,
    matrix: Vec<f32>,
}

impl Affinity {
    /// Returns the matrix before the learner's first: 1 / `num_actions` everywhere, the softmax of zeros, version 0.
    pub fn uniform(num_actions: u32) -> Self {
        let n = num_actions as usize;
        Self {
            version: 0,
            from_another: false,
            num_actions,
            matrix: vec![1.0 / num_actions as f32; n * n],
        }
    }

    /// Takes a newer matrix; one that is not newer is ignored.
    pub fn update(&mut self, update: &AffinityUpdate) -> Result<(), CodecError> {
        update.validate(self.num_actions)?;
        if update.version > self.version || self.from_another {
            self.version = update.version;
            self.from_another = false;
            self.matrix.copy_from_slice(&update.matrix);
        }
        Ok(())
    }

    /// Whether the matrix is for this number of actions and consists of probabilities.
    pub(crate) fn is_for(&self, num_actions: u32) -> bool {
        let n = num_actions as usize;
        let are_probabilities = self.matrix.iter().all(|p| (0.0..=1.0).contains(p));
        self.num_actions == num_actions && self.matrix.len() == n * n && are_probabilities
    }

    /// Returns the version in use; 0 is the uniform matrix.
    pub const fn version(&self) -> u64 {
        self.version
    }

    /// Returns A[from, to].
    pub fn get(&self, from: u8, to: u8) -> f32 {
        self.matrix[usize::from(from) * self.num_actions as usize + usize::from(to)]
    }
}
