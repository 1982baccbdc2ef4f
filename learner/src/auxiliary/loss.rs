//! The interface of auxiliary losses: the trait that a file of this folder implements, its inputs and its results.
//! It names no loss; the menu is in `super`.

use std::fmt;

use candle_core::{D, Device, Tensor};
use driml_model::{DimHeads, Encoder, Features, LossLayer, ModelConfig, Network};

use super::{
    positives::Positives,
    settings::{AuxiliarySettings, Lambda},
};
use crate::{
    batch::Batch,
    deduplicate::{PassInput, StateBytes},
    error::Result,
    losses::scores::{DotProducts, ScoreClip},
    tensors::states_tensor,
};

/// A loss is at chance above this share of the logarithm of the number of candidates.
const CHANCE_SHARE: f32 = 0.9;
/// Scores beyond this many bounds of the soft clip have less than a hundredth of their gradient.
const STUCK_CLIPS: f64 = 3.0;

/// An item of the menu: what is known of a loss before its settings are read.
#[derive(Debug)]
pub struct MenuItem {
    /// The loss's name, a value of `learner.update.auxiliary_loss`.
    pub name: &'static str,
    /// What the loss compares s_t with.
    pub positives: Positives,
    /// The names of all losses that may be reported, which are columns of a run's metrics.
    pub loss_names: &'static [&'static str],
    /// Creates the loss from settings; rejects settings that contradict each other.
    pub make: fn(&AuxiliarySettings<'_>) -> Result<Box<dyn AuxiliaryLoss>>,
}

/// What an agent learns beside the return.
pub trait AuxiliaryLoss: fmt::Debug + Send + Sync {
    /// The heads of DIM that the online network needs, if any; `action` says whether Psi receives a_t.
    fn heads(&self, _action: bool) -> DimHeads {
        DimHeads::NONE
    }

    /// Extra linear layers, which the online network builds and [`Network::loss_layer`] applies. `model` has all other sizes, such as
    /// `hidden`, the width of f4.
    fn layers(&self, _model: &ModelConfig) -> Vec<LossLayer> {
        Vec::new()
    }

    /// For a loss with a key encoder, which is a moving average of torso and Psi_4: the online network's share in the key encoder's move
    /// after each update, in (0, 1].
    fn key_tau(&self) -> Option<f64> {
        None
    }

    /// The passes of an update beyond those of C51, if a row has `positives` later states; `cost` counts them.
    fn passes(&self, positives: usize, augmented: bool) -> Passes;

    /// The later states, of `state_bytes` bytes each, whose online features the loss needs, if any. They pass through the network together
    /// with s_t; `None` stands for a blank state.
    fn later_states<'a>(&self, _batch: &Batch<'a>, _state_bytes: usize) -> Vec<StateBytes<'a>> {
        Vec::new()
    }

    /// Computes the losses of one batch, with their graphs.
    fn losses(&self, inputs: &LossInputs<'_>) -> Result<Vec<WeightedLoss>>;
}

/// The passes through parts of the networks beyond those of C51, per row of a batch.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Passes {
    /// States beyond s_t through the torso, forward and backward.
    pub states: u64,
    /// States through the key encoder, torso and Psi_4, forward alone.
    pub keys: u64,
    /// Vectors of each existing Psi, forward and backward.
    pub psi: u64,
    /// Vectors of each existing Phi, forward and backward.
    pub phi: u64,
    /// Matrices of dot products [B, B] at each location of f3.
    pub local_scores: u64,
    /// Matrices of dot products [B, B] of global features alone.
    pub global_scores: u64,
}

impl Passes {
    /// The passes of InfoNCE between levels of (s_t, a_t) and of each of `positives` later states; all states pass forward and backward.
    pub fn for_pairs(lambda: Lambda, positives: usize, augmented: bool) -> Self {
        let [local @ .., global] = lambda.active_pairs();
        let positives = positives as u64;
        Self {
            states: positives + u64::from(augmented),
            keys: 0,
            psi: 1,
            phi: positives,
            local_scores: positives * local.into_iter().map(u64::from).sum::<u64>(),
            global_scores: positives * u64::from(global),
        }
    }
}

/// One loss of a batch.
#[derive(Debug)]
pub struct WeightedLoss {
    /// One of [`MenuItem::loss_names`].
    pub name: &'static str,
    /// The loss's weight in the total.
    pub weight: f64,
    /// The loss as a scalar, before its weight.
    pub loss: Tensor,
    /// The dot products of an InfoNCE loss, else empty. They tell whether its scores saturate.
    pub dot_products: Vec<DotProducts>,
}

impl WeightedLoss {
    /// Whether this loss, of `nats` over `valid` rows, is stuck at chance because its scores lie beyond the soft clip's bound, where they have
    /// no gradient. That happens if what all states share outweighs what tells them apart.
    pub(crate) fn is_stuck(&self, nats: f32, valid: usize, tanh_clip: f64) -> Result<bool> {
        let Some(dots) = self.dot_products.first() else {
            return Ok(false);
        };
        let candidates = valid.min(dots.values.dim(D::Minus1)?);
        if candidates < 2 || nats < CHANCE_SHARE * (candidates as f32).ln() {
            return Ok(false);
        }
        let size: f32 = dots.values.abs()?.mean_all()?.to_scalar()?;
        let score = f64::from(size) * ScoreClip::new(dots.width, tanh_clip).scale;
        Ok(score > STUCK_CLIPS * tanh_clip)
    }
}

/// The online network's features of all states that an update needs with a graph, from one pass through the network.
///
/// A second pass would pack the weights again and make another gradient of each.
#[derive(Debug)]
pub struct OnlineFeatures {
    /// Features of s_t without augmentation.
    pub now: Features,
    /// Features of s_t as the loss sees it: augmented, if the batch is.
    pub anchors: Features,
    /// Features of the loss's [`AuxiliaryLoss::later_states`]; `None` if it has none.
    pub later: Option<Features>,
}

/// The inputs of an auxiliary loss.
pub struct LossInputs<'a> {
    /// The network that learns.
    pub online: &'a Network,
    /// Sizes of the online network.
    pub model: &'a ModelConfig,
    /// The batch to learn from, already checked.
    pub batch: &'a Batch<'a>,
    /// The online network's features of the batch's states.
    pub features: &'a OnlineFeatures,
    /// The key encoder of a loss with a [`AuxiliaryLoss::key_tau`].
    pub key_encoder: Option<&'a Encoder>,
    /// The device of the networks, to which states are copied.
    pub device: &'a Device,
}

impl LossInputs<'_> {
    /// Computes the key encoder's vectors [P * B, embedding_dim] of the batch's positives, without a gradient. A missing
    /// positive is a blank state.
    ///
    /// # Panics
    /// If the loss has no [`AuxiliaryLoss::key_tau`].
    pub fn key_vectors(&self) -> Result<Tensor> {
        let encoder = self.key_encoder;
        let encoder = encoder.expect("a loss with key_tau is given its encoder");
        let (batch, len) = (self.batch, self.model.frame_len());
        let positives = batch.positive_states(len);
        let PassInput { bytes, .. } = PassInput::new(&positives, batch.states_k, len, false);
        Ok(encoder.encode(&states_tensor(self.model, bytes, self.device)?)?)
    }

    /// a_t [B], on the CPU, where the network reads it.
    pub fn action(&self) -> Result<Tensor> {
        let action = self.batch.action;
        Ok(Tensor::from_slice(action, action.len(), &Device::Cpu)?)
    }
}
