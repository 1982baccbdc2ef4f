//! The network as actors run it: states in, best actions out.
//! It has no DIM heads and no exploration.

use candle_core::{Device, Tensor};

use crate::{ModelConfig, ModelError, Network, Parameters};

/// Torso and C51 head, ready to run.
pub struct PolicyNetwork {
    config: ModelConfig,
    network: Network,
}

fn load(config: &ModelConfig, safetensors: &[u8]) -> Result<Network, ModelError> {
    let parameters = Parameters::load_safetensors(config, safetensors, &Device::Cpu)?;
    Network::new(config, &parameters)
}

impl PolicyNetwork {
    /// A network with the weights of a safetensors file.
    ///
    /// # Errors
    /// Sizes that cannot work, or weights that do not fit them.
    pub fn new(config: &ModelConfig, safetensors: &[u8]) -> Result<Self, ModelError> {
        let config = config.without_dim();
        Ok(Self { network: load(&config, safetensors)?, config })
    }

    /// Replaces the weights; on an error the old ones stay.
    ///
    /// # Errors
    /// Weights that do not fit the model.
    pub fn load(&mut self, safetensors: &[u8]) -> Result<(), ModelError> {
        self.network = load(&self.config, safetensors)?;
        Ok(())
    }

    /// Writes the best action of each state: `states` [B, H, W, C], `actions` [B]. Of equal ones the first.
    ///
    /// # Errors
    /// States of another size.
    pub fn greedy_actions(&mut self, states: &[u8], actions: &mut [u8]) -> Result<(), ModelError> {
        let q = self.q_values(states, actions.len())?;
        for (action, q) in actions.iter_mut().zip(q.chunks_exact(self.config.num_actions)) {
            let best = q.iter().enumerate().fold(0, |best, (i, value)| if *value > q[best] { i } else { best });
            *action = best as u8;
        }
        Ok(())
    }

    /// Expected returns [B, A] of `states` [B, H, W, C].
    ///
    /// # Errors
    /// States of another size.
    pub fn q_values(&mut self, states: &[u8], batch: usize) -> Result<Vec<f32>, ModelError> {
        let ModelConfig { height, width, channels, .. } = self.config;
        let frames = Tensor::from_slice(states, (batch, height, width, channels), &Device::Cpu)?;
        let logits = self.network.logits(&self.network.features(&frames)?.f4)?;
        Ok(self.network.q_values(&logits)?.flatten_all()?.to_vec1()?)
    }
}
