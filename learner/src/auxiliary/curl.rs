//! CURL: InfoNCE between two views of the same state, the second one encoded by a moving average of the network.
//! It makes no view: `augment` does.
//!
//! The query is psi_4(f4) of the online network, the key psi_4(f4) of the key encoder. No gradient reaches the key. The key
//! encoder is apart from C51's target network, which is the same for every agent and would move once in hundreds of updates.
//! Source: Srinivas et al. 2020 and He et al. 2020 for the two views and the momentum encoder; Mazoure et al. 2020, appendix:
//! "exactly the same networks for measuring similarity (i.e. one residual block for CURL and CPC)", hence no bilinear
//! product and no second head.

use candle_core::Tensor;
use driml_model::{DimParts, Encoder, Features, ModelConfig, Network, Operations, Parameters};
use serde::{Deserialize, Serialize};

use super::dim::{self, Dots};
use crate::{
    error::UpdateError,
    losses::{info_nce::info_nce_loss, scores::Scores},
    optimiser::target,
};

/// The one head; the key encoder has its copy.
pub const HEADS: DimParts = DimParts {
    psi3: false,
    phi3: false,
    psi4: true,
    phi4: false,
    action: false,
};

/// The key encoder's pace.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CurlSettings {
    /// Share of the online network in the key encoder's move after each update, in (0, 1].
    pub key_tau: f64,
}

impl CurlSettings {
    /// Checks the range.
    ///
    /// # Errors
    /// A share out of it, with its value.
    pub fn validate(&self) -> Result<(), UpdateError> {
        let Self { key_tau } = *self;
        if key_tau > 0.0 && key_tau <= 1.0 {
            return Ok(());
        }
        Err(UpdateError::Settings(format!("curl.key_tau = {key_tau}")))
    }
}

/// The CURL objective's settings.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Curl {
    /// Bound c of the scores' soft clip `c * tanh(x / c)`.
    pub tanh_clip: f64,
}

impl Curl {
    /// The loss, a scalar, before its weight, in the place of the pair 4t4.
    ///
    /// `query` are the online network's features of one view, `keys` [B, rkhs] the key encoder's vectors of the other;
    /// `action` [B] gives the rows, all of which take part: a state needs no successor here.
    ///
    /// # Errors
    /// A network without the head.
    pub fn losses(
        &self,
        online: &Network,
        query: &Features,
        keys: &Tensor,
        action: &Tensor,
    ) -> Result<[Option<Tensor>; 4], UpdateError> {
        let query = online.psi4(&query.f4, action)?;
        let Dots { dots, rkhs } = dim::global_dots(&query, keys)?;
        let scores = Scores::new(rkhs, self.tanh_clip);
        let all = vec![1; action.elem_count()];
        let loss = info_nce_loss(&dots, &all, scores, online.operations())?;
        Ok([None, None, None, Some(loss)])
    }
}

/// A slow copy of the online network's torso and Psi_4.
#[derive(Debug)]
pub struct KeyEncoder {
    settings: CurlSettings,
    operations: Operations,
    parameters: Parameters,
    encoder: Encoder,
}

impl KeyEncoder {
    /// The key encoder of a network of `model` on these parameters, of which it must have all.
    ///
    /// # Errors
    /// A parameter that is missing.
    pub fn new(
        model: &ModelConfig,
        settings: CurlSettings,
        operations: Operations,
        parameters: Parameters,
    ) -> Result<Self, UpdateError> {
        Ok(Self {
            encoder: Encoder::new(model, &parameters, operations)?,
            settings,
            operations,
            parameters,
        })
    }

    /// What a key encoder has of `online`, copied: where it starts.
    ///
    /// # Errors
    /// A failing copy.
    pub fn copy_of(online: &Parameters) -> Result<Parameters, UpdateError> {
        Ok(online.copy_part(Encoder::has)?)
    }

    /// Its parameters, under the online network's names.
    pub const fn parameters(&self) -> &Parameters {
        &self.parameters
    }

    /// Keys [B, rkhs] of `frames` [B, H, W, C] u8, without a gradient.
    ///
    /// # Errors
    /// Frames of another size.
    pub fn keys(&self, frames: &Tensor) -> Result<Tensor, UpdateError> {
        Ok(self.encoder.encode(frames)?)
    }

    /// Moves after an update: `key <- key_tau * online + (1 - key_tau) * key`.
    ///
    /// # Errors
    /// An online network that lacks a parameter of it.
    pub fn follow(&self, online: &Parameters) -> Result<(), UpdateError> {
        let tau = self.settings.key_tau;
        target::follow(&self.parameters, online, tau, self.operations)
    }
}
