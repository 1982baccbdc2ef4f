//! The key encoder: a moving average of the online network's torso and Psi_4, by which a loss may encode its positives.
//! It is apart from C51's target network, which is the same for every agent and would move once in hundreds of updates.

use candle_core::Tensor;
use driml_model::{Encoder, Kernels, ModelConfig, Parameters};

use crate::{error::UpdateError, optimiser::target};

/// A slow copy of the online network's torso and Psi_4.
#[derive(Debug)]
pub struct KeyEncoder {
    tau: f64,
    kernels: Kernels,
    parameters: Parameters,
    encoder: Encoder,
}

impl KeyEncoder {
    /// The key encoder of a network of `model` on these parameters, of which it must have all. `tau` is the online network's share
    /// in a move, in (0, 1].
    pub fn new(
        model: &ModelConfig,
        tau: f64,
        kernels: Kernels,
        parameters: Parameters,
    ) -> Result<Self, UpdateError> {
        Ok(Self {
            encoder: Encoder::new(model, &parameters, kernels)?,
            tau,
            kernels,
            parameters,
        })
    }

    /// What a key encoder has of `online`, copied: where it starts.
    pub fn copy_of(online: &Parameters) -> Result<Parameters, UpdateError> {
        Ok(online.copy_part(Encoder::has)?)
    }

    /// Its parameters, under the online network's names.
    pub const fn parameters(&self) -> &Parameters {
        &self.parameters
    }

    /// Keys [B, embedding_dim] of `frames` [B, H, W, C] u8, without a gradient.
    pub fn keys(&self, frames: &Tensor) -> Result<Tensor, UpdateError> {
        Ok(self.encoder.encode(frames)?)
    }

    /// Moves after an update: `key <- tau * online + (1 - tau) * key`.
    pub fn follow(&self, online: &Parameters) -> Result<(), UpdateError> {
        target::follow(&self.parameters, online, self.tau, self.kernels)
    }
}
