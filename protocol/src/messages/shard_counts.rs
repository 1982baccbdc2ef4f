//! What each replay server counts and tells the others of, by way of the learner, so that their rate limiters decide as one.

use serde::{Deserialize, Serialize};

/// What the rate limiter counts.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct ShardCounts {
    /// Transitions stored since the start of the run.
    pub inserted: u64,
    /// Rows sampled since the start of the run.
    pub rows_sampled: u64,
}

impl std::ops::Add for ShardCounts {
    type Output = Self;

    fn add(self, other: Self) -> Self {
        Self {
            inserted: self.inserted.saturating_add(other.inserted),
            rows_sampled: self.rows_sampled.saturating_add(other.rows_sampled),
        }
    }
}
