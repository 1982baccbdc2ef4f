//! Computes the losses and gradients of a checked batch: the passes through the networks, the C51 target, and both losses.
//! It takes no optimiser step: `agent` does.

use std::ops::Range;

use candle_core::Tensor;
use driml_model::{Compute, Encoder, HeadNoise, ModelConfig, Network, Parameters, argmax};
use driml_protocol::NO_ACTION;
use rand_chacha::{ChaCha8Rng, rand_core::SeedableRng};

use crate::{
    auxiliary::loss::{AuxiliaryLoss, LossInputs, OnlineFeatures, WeightedLoss},
    batch::Batch,
    deduplicate::{PassInput, StateBytes},
    error::{Result, UpdateError},
    losses::{
        c51::{kl_loss, row_kls, softmax},
        projection::{project, share_beyond},
    },
    optimiser::gradients::Gradients,
    settings::UpdateSettings,
    tensors::{read_finite, states_tensor, to_vec_f32},
};

/// The losses of a batch.
#[derive(Clone, Debug, PartialEq)]
pub struct Losses {
    /// Mean over rows of `KL(projected target || prediction)`, in nats; each row is multiplied by its importance weight, if it has one.
    pub c51_kl: f32,
    /// The divergence of each row [B] before its weight, in nats; empty if rows have no importance weights.
    pub row_kls: Vec<f32>,
    /// The auxiliary losses, by name, before their weights; those of weight 0 are not computed.
    pub auxiliary: Vec<(&'static str, f32)>,
    /// `c51_kl + sum of weight * loss`.
    pub total: f32,
    /// Share of the rows whose target's mean lies beyond the atoms.
    pub share_beyond: f64,
    /// The auxiliary loss, if any, that is stuck at chance because its scores lie beyond `tanh_clip`.
    pub stuck_loss: Option<&'static str>,
}

/// The losses of a batch, what they were computed from, and the gradients, before any optimiser step.
#[derive(Debug)]
pub struct LossesAndGradients {
    /// The losses, which the report of an update contains too.
    pub losses: Losses,
    /// Online logits [B, N] of the actions taken in s_t, detached from the graph.
    pub taken_logits: Tensor,
    /// Greedy action in s_{t+n} [B]; [`NO_ACTION`] if the row does not bootstrap, as its s_{t+n} is not evaluated.
    pub next_greedy_action: Vec<u8>,
    /// Projected target distributions [B, N].
    pub target_projection: Vec<f32>,
    /// Gradients of the total, before clipping.
    pub gradients: Gradients,
}

/// The noise of one update: a separate draw for each use of the head, shared by all rows of the batch. A field is `None` if the head has
/// no noisy layers, or if they are to use their means.
///
/// Source: Fortunato et al. 2018, algorithm 1, with its third noise for the choice of the action by double DQN.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct UpdateNoise {
    /// Noise of the online network in s_t.
    pub online: Option<HeadNoise>,
    /// Noise of the online network when it chooses an action in s_{t+n}, with double DQN.
    pub double_dqn: Option<HeadNoise>,
    /// Noise of the target network.
    pub target: Option<HeadNoise>,
}

impl UpdateNoise {
    /// Draws the noise of the update that follows `updates` updates. The same arguments give the same noise.
    pub fn draw(model: &ModelConfig, seed: [u8; 32], updates: u64) -> Self {
        // ChaCha is counter-based: its output is a function of seed, stream and position.
        let mut rng = ChaCha8Rng::from_seed(seed);
        rng.set_stream(updates);
        let mut draw = || HeadNoise::draw(model, &mut rng);
        Self {
            online: draw(),
            double_dqn: draw(),
            target: draw(),
        }
    }
}

/// The networks that a batch passes through, and their settings.
#[derive(Debug)]
pub(crate) struct Networks {
    pub(crate) model: ModelConfig,
    pub(crate) settings: UpdateSettings,
    pub(crate) compute: Compute,
    /// Whether equal states of a batch are computed once.
    pub(crate) deduplicate: bool,
    pub(crate) auxiliary: Box<dyn AuxiliaryLoss>,
    /// The online network's parameters.
    pub(crate) parameters: Parameters,
    pub(crate) online: Network,
    pub(crate) target: Network,
    /// The key encoder of a loss that has one.
    pub(crate) key_encoder: Option<Encoder>,
}

/// The target of the C51 loss.
struct BellmanTarget {
    /// Greedy action in s_{t+n} [B]; [`NO_ACTION`] if the row does not bootstrap.
    next_greedy_action: Vec<u8>,
    /// Target distributions [B, N], moved one Bellman step and projected onto the atoms.
    projection: Vec<f32>,
    /// Share of the rows whose mean lies beyond the atoms before the projection.
    share_beyond: f64,
}

impl Networks {
    /// Computes losses and gradients of `batch`, which has been checked, with the given noise of the noisy layers.
    pub(crate) fn gradients(
        &self,
        batch: &Batch<'_>,
        noise: &UpdateNoise,
    ) -> Result<LossesAndGradients> {
        // The two are independent: while one works on a single thread, the other's matrix products use the remaining threads.
        let (target, features) = rayon::join(
            || self.bellman_target(batch, noise),
            || self.online_features(batch),
        );
        let target = target?;
        let features = features?;
        let taken_logits =
            self.online
                .taken_logits(&features.now.f4, batch.action, noise.online.as_ref())?;
        let kl = kl_loss(
            &taken_logits,
            target.projection.clone(),
            batch.importance_weight.map(<[f32]>::to_vec),
            self.compute.kernels,
        )?;
        let auxiliary = self.auxiliary_losses(batch, &features)?;
        let mut total = kl.clone();
        for WeightedLoss { loss, weight, .. } in &auxiliary {
            total = (total + loss.affine(*weight, 0.0)?)?;
        }
        // Before any number is read: reading waits for a GPU, which should have all of its work queued by then.
        let gradients = Gradients::compute(&self.parameters, &total)?;
        let c51_kl = read_finite("the C51 loss", &kl)?;
        let mut auxiliary_nats = Vec::with_capacity(auxiliary.len());
        let mut stuck_loss = None;
        let valid = batch.positive_valid.iter().filter(|it| **it != 0).count();
        for it in &auxiliary {
            let nats = read_finite(it.name, &it.loss)?;
            auxiliary_nats.push((it.name, nats));
            if it.is_stuck(nats, valid, self.settings.tanh_clip)? {
                stuck_loss = Some(it.name);
            }
        }
        let taken_logits = taken_logits.detach();
        let row_kls = match batch.importance_weight {
            None => Vec::new(),
            Some(_) => {
                let logits = to_vec_f32(&taken_logits)?;
                let kls = row_kls(&logits, &target.projection, self.model.atoms);
                kls.into_iter().map(|kl| kl as f32).collect()
            }
        };
        let losses = Losses {
            c51_kl,
            row_kls,
            auxiliary: auxiliary_nats,
            total: read_finite("the total loss", &total)?,
            share_beyond: target.share_beyond,
            stuck_loss,
        };
        Ok(LossesAndGradients {
            losses,
            taken_logits,
            next_greedy_action: target.next_greedy_action,
            target_projection: target.projection,
            gradients,
        })
    }

    /// Passes the states of `batch` that the auxiliary loss needs through the online network. It does not deduplicate augmented batches:
    /// each state has a draw.
    pub(crate) fn online_features(&self, batch: &Batch<'_>) -> Result<OnlineFeatures> {
        let len = self.model.frame_len();
        let mut states: Vec<StateBytes<'_>> = batch.states_t.chunks_exact(len).map(Some).collect();
        let anchors = batch.anchors.unwrap_or_default().chunks_exact(len);
        states.extend(anchors.map(Some));
        let anchor_count = states.len() - batch.rows;
        states.extend(self.auxiliary.later_states(batch, len));

        let deduplicate = self.deduplicate && anchor_count == 0;
        let input = PassInput::new(&states, batch.states_t, len, deduplicate);
        let tensor = states_tensor(&self.model, input.bytes, &self.compute.device)?;
        let features = self.online.features(&tensor)?;
        let features_of = |range: Range<usize>| match &input.indices {
            Some(indices) => features.select(&indices[range]),
            None => features.narrow(range.start, range.len()),
        };
        let some_features =
            |range: Range<usize>| (!range.is_empty()).then(|| features_of(range)).transpose();
        let (first_anchor, first_later) = (batch.rows, batch.rows + anchor_count);
        let now = features_of(0..first_anchor)?;
        Ok(OnlineFeatures {
            anchors: some_features(first_anchor..first_later)?.unwrap_or_else(|| now.clone()),
            later: some_features(first_later..states.len())?,
            now,
        })
    }

    /// Computes the auxiliary losses of `batch`, whose `features` are given.
    pub(crate) fn auxiliary_losses(
        &self,
        batch: &Batch<'_>,
        features: &OnlineFeatures,
    ) -> Result<Vec<WeightedLoss>> {
        self.auxiliary.losses(&LossInputs {
            online: &self.online,
            model: &self.model,
            batch,
            features,
            key_encoder: self.key_encoder.as_ref(),
            device: &self.compute.device,
        })
    }

    /// Computes the target distributions, of the actions that are greedy in s_{t+n}, without a graph.
    ///
    /// Rows that do not bootstrap skip the pass: whatever s_{t+n} is, all of their probability goes to their return.
    fn bellman_target(&self, batch: &Batch<'_>, noise: &UpdateNoise) -> Result<BellmanTarget> {
        let atoms = self.model.atoms;
        let mut next_greedy_action = vec![NO_ACTION; batch.rows];
        let mut probs = vec![0f32; batch.rows * atoms];
        for probs in probs.chunks_exact_mut(atoms) {
            probs[0] = 1.0;
        }
        let bootstraps: Vec<usize> = batch.bootstrapping_rows().collect();
        if !bootstraps.is_empty() {
            let (actions, logits) = self.next_greedy_actions(batch, noise)?;
            let rows = bootstraps.iter().zip(actions);
            for ((&row, action), logits) in rows.zip(logits.chunks_exact(atoms)) {
                next_greedy_action[row] = action;
                softmax(logits, &mut probs[row * atoms..][..atoms]);
            }
        }
        if !probs.iter().all(|p| p.is_finite()) {
            let what = "the target network's distribution";
            return Err(UpdateError::NonFinite(what.to_owned()));
        }
        let (reward, discount) = (batch.n_step_return, batch.bootstrap_discount);
        let (v_min, v_max) = (self.model.v_min, self.model.v_max);
        let mut projection = vec![0f32; probs.len()];
        project(&probs, reward, discount, v_min, v_max, &mut projection);
        Ok(BellmanTarget {
            next_greedy_action,
            projection,
            share_beyond: share_beyond(&probs, reward, discount, v_min, v_max),
        })
    }

    /// Computes, for the n rows that bootstrap, the greedy actions in s_{t+n} [n] and the target network's logits of these actions [n, N].
    fn next_greedy_actions(
        &self,
        batch: &Batch<'_>,
        noise: &UpdateNoise,
    ) -> Result<(Vec<u8>, Vec<f32>)> {
        let (num_actions, atoms) = (self.model.num_actions, self.model.atoms);
        let len = self.model.frame_len();
        let frames = batch.next_states(len);
        let PassInput { bytes, indices } =
            PassInput::new(&frames, batch.states_n, len, self.deduplicate);
        let states_n = states_tensor(&self.model, bytes, &self.compute.device)?;
        let target_logits = detached_logits(&self.target, &states_n, noise.target.as_ref())?;
        let (network, values) = if self.settings.double_dqn {
            let logits = detached_logits(&self.online, &states_n, noise.double_dqn.as_ref())?;
            ("online", self.online.q_values(&logits)?)
        } else {
            ("target", self.target.q_values(&target_logits)?)
        };
        let values = to_vec_f32(&values)?;
        if !values.iter().all(|q| q.is_finite()) {
            let what = format!("the {network} network's value of an s_{{t+n}}");
            return Err(UpdateError::NonFinite(what));
        }
        let greedy_by_state: Vec<u8> = values.chunks_exact(num_actions).map(argmax).collect();
        let logits = to_vec_f32(&target_logits)?;
        let (mut actions, mut chosen) = (Vec::new(), Vec::with_capacity(frames.len() * atoms));
        for row in 0..frames.len() {
            let state = indices.as_ref().map_or(row, |it| it[row] as usize);
            let action = greedy_by_state[state];
            let start = (state * num_actions + usize::from(action)) * atoms;
            chosen.extend_from_slice(&logits[start..start + atoms]);
            actions.push(action);
        }
        Ok((actions, chosen))
    }
}

/// Computes the logits [B, A, N] of `frames`, detached from the graph.
pub(crate) fn detached_logits(
    network: &Network,
    frames: &Tensor,
    noise: Option<&HeadNoise>,
) -> Result<Tensor> {
    let f4 = network.features(frames)?.f4;
    Ok(network.logits(&f4, noise)?.detach())
}
