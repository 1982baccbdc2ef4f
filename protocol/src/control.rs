//! How parts join a run and leave it.
//! It does not start or stop processes: that is the launcher's.

use serde::{Deserialize, Serialize};

/// What a joining part needs: the run's resolved settings, from the replay server.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Hello {
    /// The resolved configuration, TOML.
    pub config_toml: String,
    /// Transitions that the run has stored, for the exploration schedule.
    pub inserted_total: u64,
    /// Updates after which the run goes on, if it was resumed; 0 in a run from its start.
    pub after_updates: u64,
    /// Which of the replay's shards this is, from 0, and how many there are.
    pub shard: (u32, u32),
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
