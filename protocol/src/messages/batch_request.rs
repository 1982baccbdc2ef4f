//! The learner's request for a batch, and the numbers that tell a repeated request from a new one.
//! The replay server chooses the rows of a batch.

use serde::{Deserialize, Serialize};

/// The learner's request for a batch.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct BatchRequest {
    /// The learner's number, as in its [`LearnerJoin`](crate::LearnerJoin).
    pub learner: u64,
    /// The identity of this request.
    pub id: RequestId,
    /// Rows wanted, B.
    pub rows: u32,
    /// Whether the batch may be sent through shared memory.
    pub shared_memory: bool,
    /// The learner's progress.
    pub learned: LearnerProgress,
    /// The sum of the counts of all other shards, if the replay has several. The rows are then a part of a batch.
    pub other_shards: Option<ShardCounts>,
}

/// The progress of a learner, which only the learner knows. A restarted replay server learns it from here.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct LearnerProgress {
    /// Updates since the start of the run.
    pub updates: u64,
    /// Updates in its newest checkpoint.
    pub saved_updates: u64,
    /// Rows of this shard that the learner has received since the start of the run, without rows that an earlier learner learned from after
    /// this learner's checkpoint.
    pub rows_received: u64,
}

/// Tells a repeated request from a new one, because a batch that did not arrive must not count as sampled.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct RequestId {
    /// The client's random number, which no other client has. A client waits for one request at a time.
    pub client_id: u64,
    /// Number of earlier requests of this client that were answered.
    pub number: u64,
    /// The attempt at this request; a later attempt has a higher number.
    pub attempt: u64,
}

impl RequestId {
    /// The first request of a client.
    pub const fn first(client_id: u64) -> Self {
        Self {
            client_id,
            number: 0,
            attempt: 0,
        }
    }

    /// The next attempt at this request.
    #[must_use]
    pub const fn retry(self) -> Self {
        Self {
            attempt: self.attempt + 1,
            ..self
        }
    }

    /// The next request, once this one is answered.
    #[must_use]
    pub const fn next(self) -> Self {
        Self {
            number: self.number + 1,
            attempt: 0,
            ..self
        }
    }
}

/// The counts of one replay server's rate limiter. The learner tells each server the counts of the others, so that all decide as one.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct ShardCounts {
    /// Transitions stored since the start of the run.
    pub inserted: u64,
    /// Rows sampled since the start of the run.
    pub rows_sampled: u64,
}

impl ShardCounts {
    /// The counts of a replay server that stored `inserted` transitions and sampled `rows_sampled` rows.
    pub const fn new(inserted: u64, rows_sampled: u64) -> Self {
        Self {
            inserted,
            rows_sampled,
        }
    }
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
