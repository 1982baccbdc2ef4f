//! Taking part in a run: its settings, joining it as an actor or as its learner, and an actor's end.
//! It does not start or stop processes: that is the launcher's.

use serde::{Deserialize, Serialize};

use super::batch_request::ShardCounts;

/// What a joining process needs: the run's resolved settings, from the replay server.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct RunInfo {
    /// The resolved configuration, TOML.
    pub config_toml: String,
    /// Transitions that the run has stored, for the exploration schedule.
    pub inserted_total: u64,
    /// Whether a learner has joined.
    pub has_learner: bool,
    /// Updates after which the run was resumed, which its learner says; 0 in a run from its start.
    pub after_updates: u64,
    /// Which of the replay's shards this is, from 0, and how many there are.
    pub shard: (u32, u32),
    /// Whether chunks may come through shared memory: the replay server can read it.
    pub shared_memory: bool,
}

/// An actor starts: from now on the replay server takes its chunks. The same one may be sent any number of times.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct ActorJoin {
    /// Which actor, unique in the run.
    pub actor: u32,
    /// Which life of it: a random number, drawn anew at each start.
    pub incarnation: u64,
}

/// A learner starts: from now on the replay server serves it, and it alone. The same one may be sent any number of times.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct LearnerJoin {
    /// Which learner: a random number, drawn anew at each start. All its messages carry it.
    pub learner: u64,
    /// Which run its checkpoint is of: a random number that the run's first learner drew. One without a checkpoint draws another.
    pub run: u64,
    /// Updates in its checkpoint; 0 without one.
    pub updates: u64,
    /// What this shard had counted at the checkpoint: transitions stored, and rows that the learner learned from.
    pub counts: ShardCounts,
    /// The same of all other shards together.
    pub other_shards: ShardCounts,
    /// Begin again from the first update, where an earlier learner of the run has learned already.
    pub restart: bool,
}

/// The replay server's answer to a process that joins.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum JoinReply {
    /// It takes part.
    Welcome(Welcome),
    /// Another process has this role and is connected: ask again, it may be about to end.
    Taken {
        /// Who, for a person.
        why: String,
    },
    /// Never: the reason, for a person.
    Refused {
        /// The replay server's reason, a sentence.
        why: String,
    },
}

/// What the replay server tells a process that it admits.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Welcome {
    /// Transitions that the run has stored.
    pub inserted_total: u64,
    /// Version of the newest weights that the replay server has; 0 before the first.
    pub weights_version: u64,
    /// Lives of this actor that were there before this one; 0 for a learner.
    pub earlier_incarnations: u32,
}

/// An actor's last word: its own count of what it produced, against which the replay server checks its count.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Leave {
    /// The actor's number in the run.
    pub actor: u32,
    /// Which life of it.
    pub incarnation: u64,
    /// Transitions produced, less those that the replay server answered with `Finished`. Those that it refused count as lost.
    pub produced: u64,
}
