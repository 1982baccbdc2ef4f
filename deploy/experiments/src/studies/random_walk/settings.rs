//! What the random walk can be told.

use driml_learner::AdamSettings;
use serde::{Deserialize, Serialize};

/// The contents of `config.toml` or `smoke.toml` beside this file.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Settings {
    /// States of the chain.
    pub(super) states: usize,
    /// Probabilities of a step up.
    pub(super) alphas: Vec<f64>,
    /// The one of the matrices; among `alphas`.
    pub(super) figure_alpha: f64,
    /// Seeds 1 to this. No piece depends on it, so that more can be added later.
    #[serde(skip_serializing)]
    pub(super) seeds: u32,
    /// Updates of a training.
    pub(super) updates: u64,
    /// Pairs in a batch, each with all others as negatives.
    pub(super) batch_size: usize,
    /// Width of the heads.
    pub(super) rkhs: usize,
    /// Rows sampled per transition of a single walker.
    pub(super) replay_ratio: f64,
    /// Bound of the scores' soft clip.
    pub(super) tanh_clip: f64,
    /// Global 2-norm to which gradients are clipped.
    pub(super) max_grad_norm: f64,
    /// Error of the next state's law at which a training counts as converged, a probability.
    #[serde(skip_serializing)]
    pub(super) tv_reached: f64,
    /// Share of the mutual information that is still missed when a training counts as converged.
    #[serde(skip_serializing)]
    pub(super) share_reached: f64,
    /// The optimiser's numbers.
    pub(super) adam: AdamSettings,
}
