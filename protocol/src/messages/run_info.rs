//! What a process that joins a run learns first: the run's settings, and how far the run is.
//! It does not admit the process; `join` does.

use serde::{Deserialize, Serialize};

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
