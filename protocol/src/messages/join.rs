//! Joining and leaving a run: its settings, an actor or a learner that joins, and an actor that leaves.
//! The launcher starts and stops processes; these messages do not.

use serde::{Deserialize, Serialize};

use super::batch_request::ShardCounts;

/// What a joining process needs to know of the run. The replay server sends this.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct RunInfo {
    /// The resolved settings, TOML.
    pub config_toml: String,
    /// Transitions that the run has stored, for the exploration schedule.
    pub inserted_total: u64,
    /// Whether a learner has joined.
    pub has_learner: bool,
    /// Updates after which the run was resumed without its replay, as its learner reported; 0 if it was not.
    pub after_updates: u64,
    /// The number of this shard of the replay, from 0, and the number of shards.
    pub shard: (u32, u32),
    /// Whether chunks may be sent through shared memory, because the replay server can read it.
    pub shared_memory: bool,
}

/// An actor starts. From now on, the replay server accepts its chunks. The same message may be sent any number of times.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct ActorJoin {
    /// The actor's number, unique in the run.
    pub actor: u32,
    /// The actor's incarnation: a random number, drawn at each start of the process.
    pub incarnation: u64,
}

impl ActorJoin {
    /// The join of this incarnation of an actor.
    pub const fn new(actor: u32, incarnation: u64) -> Self {
        Self { actor, incarnation }
    }
}

/// A learner starts. From now on, the replay server serves it alone. The same message may be sent any number of times.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct LearnerJoin {
    /// The learner's number, drawn at random at each start of the process. All its messages carry it.
    pub learner: u64,
    /// The run of its checkpoint: a random number that the run's first learner drew. A learner without a checkpoint draws a new one.
    pub run: u64,
    /// Updates in the learner's checkpoint; 0 without a checkpoint.
    pub updates: u64,
    /// Counts of this shard at the checkpoint: transitions stored, and rows that the learner learned from.
    pub counts: ShardCounts,
    /// The sum of these counts over all other shards.
    pub other_shards: ShardCounts,
    /// Whether to restart from the first update although an earlier learner of the run has made updates.
    pub restart: bool,
}

/// The replay server's reply to a process that joins.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum JoinReply {
    /// The process has joined.
    Welcome(Welcome),
    /// Another process with this role is connected. The process retries, as the other may be about to exit.
    Taken {
        /// Which process that is, as text for the user.
        why: String,
    },
    /// The process may not join, and a retry is useless.
    Refused {
        /// The replay server's reason, a sentence.
        why: String,
    },
    /// The replay server cannot record the process now. The process retries for as long as it takes.
    Wait {
        /// What the replay server waits for, as text for the user.
        why: String,
    },
}

/// The replay server's information for a process that it admits.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Welcome {
    /// Transitions that the run has stored.
    pub inserted_total: u64,
    /// Version of the newest weights that the replay server has; 0 before the first.
    pub weights_version: u64,
    /// Earlier incarnations of this actor; 0 for a learner.
    pub earlier_incarnations: u32,
}

/// An actor's last message: its count of the transitions that it produced. The replay server compares this with its own count.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Leave {
    /// The actor's number in the run.
    pub actor: u32,
    /// The actor's incarnation.
    pub incarnation: u64,
    /// Transitions produced, without those to which the replay server replied `Finished`. Rejected ones count as lost.
    pub produced: u64,
}

impl Leave {
    /// The last message of this incarnation of an actor.
    pub const fn new(actor: u32, incarnation: u64, produced: u64) -> Self {
        Self {
            actor,
            incarnation,
            produced,
        }
    }
}
