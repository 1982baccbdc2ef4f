//! What the Ising experiment can be told.

use serde::{Deserialize, Serialize};

/// The contents of `config.toml` or `smoke.toml` beside this file.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Settings {
    /// What differs from the settings of a run in this world, in the form of `--set`.
    pub(super) sets: Vec<String>,
    /// Seeds 1 to this. No piece depends on it, so that more can be added later.
    #[serde(skip_serializing)]
    pub(super) seeds: u32,
    /// Updates of a training.
    pub(super) updates: u64,
    /// Pairs in a batch, each with all others as negatives.
    pub(super) batch_size: usize,
    /// Measurements before the end.
    pub(super) checks: u64,
    /// Episodes of each.
    pub(super) check_episodes: usize,
    /// Episodes of the measurement at the end.
    pub(super) episodes: usize,
    /// Scores are those from this environment step to the next.
    pub(super) from_t: u32,
    /// The environment step of the late lattices.
    pub(super) late_t: u32,
}
