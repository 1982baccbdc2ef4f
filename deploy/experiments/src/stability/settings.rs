//! How much the experiment tries.
//! It holds no numbers: those are in `config.toml`.

use serde::{Deserialize, Serialize};

/// A table of `config.toml`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Settings {
    /// Seeds 1 to this. No piece depends on it, so that more can be added later.
    #[serde(skip_serializing)]
    pub(super) seeds: u32,
    /// Random inputs of a quick routine; slower ones take a share of it.
    pub(super) draws: u64,
    /// Steps of the longest run of Adam.
    pub(super) adam_steps: u64,
    /// Most moves of a target network towards one that stands still; a tau that needs more is left out.
    pub(super) follow_moves: u64,
    /// Updates of the learned affinity.
    pub(super) affinity_updates: u64,
    /// Draws from each law that is tested.
    pub(super) law_draws: u64,
    /// Random probabilities for which every value that can be drawn is drawn.
    pub(super) whole_draws: u64,
}
