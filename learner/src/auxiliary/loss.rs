//! What every auxiliary loss is: the trait that a file of this folder implements, what it is given, and what it gives back.
//! It names no loss; the menu is in `super`.

use std::{borrow::Cow, fmt};

use candle_core::{Device, Tensor};
use driml_model::{DimParts, Features, ModelConfig, Network};

use super::{
    key_encoder::KeyEncoder,
    positives::Positives,
    settings::{AuxiliarySettings, Lambda},
};
use crate::{batch::Batch, error::UpdateError, losses::scores::Dots, tensors::states};

/// An item of the menu: what is known of a loss before its settings are read.
#[derive(Debug)]
pub struct MenuItem {
    /// Its name, as `learner.update.objective` has it.
    pub name: &'static str,
    /// What it compares s_t with.
    pub positives: Positives,
    /// The names of all losses that it may report, as the columns of a run's metrics have them.
    pub losses: &'static [&'static str],
    /// Makes it from settings; refuses those that are at odds with each other.
    pub make: fn(&AuxiliarySettings<'_>) -> Result<Box<dyn AuxiliaryLoss>, UpdateError>,
}

/// What an agent learns beside the return.
pub trait AuxiliaryLoss: fmt::Debug + Send + Sync {
    /// The heads that the online network needs; `action` says whether Psi is given a_t.
    fn heads(&self, action: bool) -> DimParts;

    /// For a loss with a key encoder (a moving average of torso and Psi_4): the online network's share in its move after each
    /// update, in (0, 1].
    fn key_tau(&self) -> Option<f64> {
        None
    }

    /// What an update costs beyond C51's, where a row has `positives` later states; for an estimate of a run's time.
    fn passes(&self, positives: usize, augmented: bool) -> Passes;

    /// The losses of one batch, with their graphs.
    ///
    /// # Errors
    /// A head that is not there, or a failing operation.
    fn losses(&self, inputs: &LossInputs<'_>) -> Result<Vec<WeightedLoss>, UpdateError>;
}

/// Passes through parts of the network beyond C51's, a row; one with its backward pass counts three times.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Passes {
    /// Through the torso.
    pub torso: f64,
    /// Through all heads.
    pub heads: f64,
    /// Matrices of scores [B, B], a location.
    pub scores: f64,
    /// Whether there are scores at every location of f3, not of the global features alone.
    pub local: bool,
}

impl Passes {
    /// Those of InfoNCE between levels of (s_t, a_t) and of each of `positives` later states: each state forward and backward.
    pub fn of_pairs(lambda: Lambda, positives: usize, augmented: bool) -> Self {
        let [pairs @ .., _] = lambda.wanted();
        let positives = positives as f64;
        Self {
            torso: 3.0 * (positives + f64::from(u8::from(augmented))),
            // Half of the heads are for s_t.
            heads: 3.0 * (1.0 + positives) / 2.0,
            scores: positives,
            local: pairs.contains(&true),
        }
    }
}

/// One loss of a batch.
#[derive(Debug)]
pub struct WeightedLoss {
    /// One of [`MenuItem::losses`].
    pub name: &'static str,
    /// Its weight in the total.
    pub weight: f64,
    /// A scalar, before its weight.
    pub loss: Tensor,
    /// The dot products of which it is made, if it is an InfoNCE: the parity check looks whether their scores saturate.
    pub dots: Vec<Dots>,
}

/// What a loss may look at. Nothing passes through a network before the loss asks for it.
pub struct LossInputs<'a> {
    /// The network that learns.
    pub online: &'a Network,
    /// The network's sizes.
    pub model: &'a ModelConfig,
    /// The batch.
    pub batch: &'a Batch<'a>,
    /// The online network's features of s_t, not augmented.
    pub features_t: &'a Features,
    /// The key encoder of a loss with a [`AuxiliaryLoss::key_tau`].
    pub key: Option<&'a KeyEncoder>,
    /// Where the states go.
    pub device: &'a Device,
}

impl LossInputs<'_> {
    /// The online network's features of s_t as the loss sees it: augmented, if the batch is.
    ///
    /// # Errors
    /// A failing operation.
    pub fn anchors(&self) -> Result<Features, UpdateError> {
        match self.batch.anchors {
            Some(anchors) => self.features(anchors),
            None => Ok(self.features_t.clone()),
        }
    }

    /// The online network's features of `states` [.., H, W, C], as many as there are.
    ///
    /// # Errors
    /// A failing operation.
    pub fn features<'s>(&self, states: impl Into<Cow<'s, [u8]>>) -> Result<Features, UpdateError> {
        Ok(self.online.features(&self.tensor(states)?)?)
    }

    /// The key encoder's vectors [B, rkhs] of the batch's positives, without a gradient.
    ///
    /// # Errors
    /// A failing operation.
    ///
    /// # Panics
    /// If the loss has no [`AuxiliaryLoss::key_tau`].
    pub fn keys(&self) -> Result<Tensor, UpdateError> {
        let key = self.key.expect("a loss with key_tau is given its encoder");
        key.keys(&self.tensor(self.batch.states_k)?)
    }

    /// a_t [B], on the CPU, where the network looks at them.
    ///
    /// # Errors
    /// A failing allocation.
    pub fn action(&self) -> Result<Tensor, UpdateError> {
        let action = self.batch.action;
        Ok(Tensor::from_slice(action, action.len(), &Device::Cpu)?)
    }

    fn tensor<'s>(&self, bytes: impl Into<Cow<'s, [u8]>>) -> Result<Tensor, UpdateError> {
        Ok(states(self.model, bytes, self.device)?)
    }
}
