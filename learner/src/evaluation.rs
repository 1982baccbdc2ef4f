//! What a batch's evaluation gives, and what remains of it after an update.
//! It computes nothing: `agent` does.

use candle_core::Tensor;

use crate::optimiser::gradients::Gradients;

/// What one update did: the numbers of a row of metrics.
#[derive(Clone, Debug, PartialEq)]
pub struct UpdateReport {
    /// Mean KL divergence of the prediction from the projected target, in nats; of weighted rows the mean of weight times divergence.
    pub c51_kl: f32,
    /// Of weighted rows, each one's divergence [B] before its weight, in nats; else empty, and not computed.
    pub row_kls: Vec<f32>,
    /// The auxiliary losses, by name, before their weights; those of weight 0 are not computed.
    pub losses: Vec<(&'static str, f32)>,
    /// `c51_kl + sum of weight * loss`.
    pub total: f32,
    /// Global 2-norm of the gradients before clipping.
    pub grad_norm: f64,
    /// Mean over rows of the taken action's value, in units of return.
    pub q_mean: f32,
}

/// The losses of a batch and all that led to them, before any step is taken.
#[derive(Debug)]
pub struct Evaluation {
    /// Mean KL divergence, in nats; of weighted rows the mean of weight times divergence.
    pub c51_kl: f32,
    /// Of weighted rows, each one's divergence [B] before its weight, in nats; else empty, and not computed.
    pub row_kls: Vec<f32>,
    /// The auxiliary losses, by name, before their weights; those of weight 0 are not computed.
    pub losses: Vec<(&'static str, f32)>,
    /// `c51_kl + sum of weight * loss`.
    pub total: f32,
    /// Online logits [B, N] of the actions taken in s_t, without a graph.
    pub taken_logits: Tensor,
    /// Greedy action in s_{t+n} [B]; [`NO_ACTION`](driml_protocol::NO_ACTION) where the row does not bootstrap, as nothing is
    /// computed of that state.
    pub next_greedy_action: Vec<u8>,
    /// Projected target distributions [B, N].
    pub target_projection: Vec<f32>,
    /// Gradients of the total, before clipping.
    pub gradients: Gradients,
}
