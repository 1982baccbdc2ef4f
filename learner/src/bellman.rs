//! What C51 learns to predict: distributions one Bellman step earlier, of the actions that are greedy in s_{t+n}.
//! It has no graph, and nothing here learns.

use candle_core::Tensor;
use driml_model::{Compute, HeadNoise, ModelConfig, Network, greedy};
use driml_protocol::NO_ACTION;

use crate::{
    batch::Batch,
    deduplicate::{PassInput, State},
    error::UpdateError,
    losses::{c51::softmax, projection::project},
    noise::UpdateNoise,
    tensors::{flat, states},
};

pub(crate) struct BellmanTarget {
    /// Greedy action in s_{t+n} [B]; [`NO_ACTION`] where the row does not bootstrap.
    pub(crate) next_greedy_action: Vec<u8>,
    /// Distributions on the support, one Bellman step earlier [B, N].
    pub(crate) projection: Vec<f32>,
}

/// The networks that make it, and how.
pub(crate) struct Bellman<'a> {
    pub(crate) model: &'a ModelConfig,
    pub(crate) compute: &'a Compute,
    pub(crate) online: &'a Network,
    pub(crate) target: &'a Network,
    /// Whether the online network chooses the action, not the target network.
    pub(crate) double_dqn: bool,
    pub(crate) deduplicate: bool,
}

impl Bellman<'_> {
    /// The target of this batch, whose noisy layers have this noise.
    ///
    /// Rows without a bootstrap are left out of the pass: whatever s_{t+n} is, all of their mass goes to their return.
    pub(crate) fn target(
        &self,
        batch: &Batch<'_>,
        noise: &UpdateNoise,
    ) -> Result<BellmanTarget, UpdateError> {
        let ModelConfig {
            atoms,
            v_min,
            v_max,
            ..
        } = *self.model;
        let mut next_greedy_action = vec![NO_ACTION; batch.rows];
        let mut probs = vec![0f32; batch.rows * atoms];
        for probs in probs.chunks_exact_mut(atoms) {
            probs[0] = 1.0;
        }
        let bootstraps: Vec<usize> = batch.bootstraps().collect();
        if !bootstraps.is_empty() {
            let (actions, logits) = self.next_greedy(batch, noise)?;
            for ((&row, action), logits) in bootstraps
                .iter()
                .zip(actions)
                .zip(logits.chunks_exact(atoms))
            {
                next_greedy_action[row] = action;
                softmax(logits, &mut probs[row * atoms..][..atoms]);
            }
        }
        if !probs.iter().all(|p| p.is_finite()) {
            return Err(UpdateError::NonFinite {
                what: "the target network's distribution".to_owned(),
            });
        }
        let mut projection = vec![0f32; probs.len()];
        project(
            &probs,
            batch.n_step_return,
            batch.bootstrap_discount,
            v_min,
            v_max,
            &mut projection,
        );
        Ok(BellmanTarget {
            next_greedy_action,
            projection,
        })
    }

    /// Greedy actions in s_{t+n} of the rows that bootstrap [n], and the target network's logits [n, N] of them.
    fn next_greedy(
        &self,
        batch: &Batch<'_>,
        noise: &UpdateNoise,
    ) -> Result<(Vec<u8>, Vec<f32>), UpdateError> {
        let ModelConfig {
            num_actions, atoms, ..
        } = *self.model;
        let len = self.model.frame_len();
        let frames: Vec<State<'_>> = batch.next_states(len).into_iter().map(Some).collect();
        let PassInput { bytes, places } =
            PassInput::of(&frames, batch.states_n, len, self.deduplicate);
        let states_n = states(self.model, bytes, &self.compute.device)?;
        let target_logits = distribution(self.target, &states_n, noise.target.as_ref())?;
        let (network, values) = if self.double_dqn {
            let logits = distribution(self.online, &states_n, noise.choice.as_ref())?;
            ("online", self.online.q_values(&logits)?)
        } else {
            ("target", self.target.q_values(&target_logits)?)
        };
        let values = flat(&values)?;
        if !values.iter().all(|q| q.is_finite()) {
            return Err(UpdateError::NonFinite {
                what: format!("the {network} network's value of an s_{{t+n}}"),
            });
        }
        let of_state: Vec<u8> = values.chunks_exact(num_actions).map(greedy).collect();
        let logits = flat(&target_logits)?;
        let (mut actions, mut chosen) = (Vec::new(), Vec::with_capacity(frames.len() * atoms));
        for row in 0..frames.len() {
            let state = places.as_ref().map_or(row, |it| it[row] as usize);
            let action = of_state[state];
            let at = (state * num_actions + usize::from(action)) * atoms;
            chosen.extend_from_slice(&logits[at..at + atoms]);
            actions.push(action);
        }
        Ok((actions, chosen))
    }
}

/// Logits [B, A, N] of `frames`, cut off from any graph.
pub(crate) fn distribution(
    network: &Network,
    frames: &Tensor,
    noise: Option<&HeadNoise>,
) -> Result<Tensor, UpdateError> {
    let f4 = network.features(frames)?.f4;
    Ok(network.noisy_logits(&f4, noise)?.detach())
}
