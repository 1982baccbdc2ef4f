//! The torso and Psi_4 alone, which encode states as vectors to compare with another network's, such as CURL's keys.
//! An encoder has no C51 head and sees no action.

use candle_core::Tensor;

use crate::compute::Kernels;
use crate::config::ModelConfig;
use crate::error::Result;
use crate::features::FeatureLayers;
use crate::heads::dim::DimHead;
use crate::parameters::Parameters;

/// The part of a network that encodes a state as psi_4(f4).
///
/// An encoder shares the storage of the [`Parameters`] it was built from: setting a `Var` there changes the encoder.
#[derive(Debug)]
pub struct Encoder {
    torso: FeatureLayers,
    psi4: DimHead,
}

impl Encoder {
    /// Whether the parameter of this name belongs to the encoder.
    pub fn has_parameter(name: &str) -> bool {
        name.starts_with("torso.") || name.starts_with("dim.psi4.")
    }

    /// Builds the encoder of a network of `config` on `parameters`, which may hold more than the encoder needs.
    pub fn new(config: &ModelConfig, parameters: &Parameters, kernels: Kernels) -> Result<Self> {
        config.validate()?;
        Ok(Self {
            torso: FeatureLayers::new(config, parameters, kernels)?,
            psi4: DimHead::new("dim.psi4", parameters, kernels)?,
        })
    }

    /// Computes psi_4(f4) [B, embedding_dim] of `frames` [B, H, W, C] u8, detached from any graph.
    pub fn encode(&self, frames: &Tensor) -> Result<Tensor> {
        let (_, f4) = self.torso.features(frames, false)?;
        Ok(self.psi4.forward(&f4.detach(), None)?.detach())
    }
}
