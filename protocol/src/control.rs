//! How parts join a run and leave it.
//! It does not start or stop processes: that is the launcher's.

use serde::{Deserialize, Serialize};

use crate::Tally;

/// What a joining part needs: the run's resolved settings, from the replay server.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Hello {
    /// The resolved configuration, TOML.
    pub config_toml: String,
    /// Transitions that the run has stored, for the exploration schedule.
    pub inserted_total: u64,
    /// What this replay server has counted by itself.
    pub tally: Tally,
    /// Updates after which the run goes on, if it was resumed; 0 in a run from its start.
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
    pub epoch: u64,
}

/// A learner starts: from now on the replay server serves it, and it alone. The same one may be sent any number of times.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct LearnerJoin {
    /// Which learner: a random number, drawn anew at each start. All its messages carry it.
    pub learner: u64,
    /// Rows of this shard that it has learned from. Rows served beyond them, to a learner that died, are served again.
    pub rows_sampled: u64,
}

/// The replay server's answer to a part that joins.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum JoinReply {
    /// It takes part.
    Welcome {
        /// Transitions that the run has stored.
        inserted_total: u64,
        /// Version of the newest weights that the replay server has; 0 before the first.
        weights_version: u64,
        /// Lives of this actor that were there before this one; 0 for a learner.
        earlier_lives: u32,
    },
    /// Another process plays this part and is connected: ask again, it may be about to end.
    Taken {
        /// Who, for a person.
        why: String,
    },
    /// Never: the reason, for a person.
    Refused {
        /// The reason.
        why: String,
    },
}

/// An actor's last word: its own count of what it produced, against which the replay server checks its count.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Goodbye {
    /// Which actor.
    pub actor: u32,
    /// Which life of it.
    pub epoch: u64,
    /// Transitions produced, less those that the replay server answered with `Finished` or `Refused`.
    pub produced: u64,
}
