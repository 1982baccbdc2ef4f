//! The learner's request for a batch, and how one that repeats another is told from a new one.
//! Which rows a batch has is the replay server's choice.

use serde::{Deserialize, Serialize};

/// The learner's request.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct BatchRequest {
    /// Which learner asks: that of its [`LearnerJoin`](crate::LearnerJoin).
    pub learner: u64,
    /// Which request this is.
    pub id: RequestId,
    /// Rows wanted, B.
    pub rows: u32,
    /// Whether the batch may come through shared memory.
    pub shared_memory: bool,
    /// What the learner has done so far.
    pub learned: Learned,
    /// Where the replay has several shards: what all the others have counted together, and these rows are part of a batch.
    pub other_shards: Option<ShardCounts>,
}

/// How far a learner is. It alone knows; a replay server that was started again learns it from here.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Learned {
    /// Updates since the start of the run.
    pub updates: u64,
    /// Updates in its newest checkpoint.
    pub saved_updates: u64,
    /// Rows of this shard that it has received since the start of the run, without those learned after its checkpoint by a learner
    /// before it.
    pub rows_received: u64,
}

/// Tells a request that repeats another from a new one: a batch that did not arrive must not count as sampled.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct RequestId {
    /// Who asks: a random number, which tells it from all others. It waits for one request at a time.
    pub client_id: u64,
    /// How many requests of this client were answered before.
    pub number: u64,
    /// Which attempt at this one it is: a later one has a higher number.
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

    /// The same request, sent once more.
    #[must_use]
    pub const fn again(self) -> Self {
        Self {
            attempt: self.attempt + 1,
            ..self
        }
    }

    /// The request after this one, which was answered.
    #[must_use]
    pub const fn next(self) -> Self {
        Self {
            number: self.number + 1,
            attempt: 0,
            ..self
        }
    }
}

/// What the rate limiter of each replay server counts. The learner tells each of the others, so that all decide as one.
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
