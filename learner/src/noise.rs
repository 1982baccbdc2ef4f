//! The noise of the head's noisy layers in an update, a function of the run's seed and the number of the update.
//! It needs no saved state: a resumed run draws the same noise.

use driml_model::{HeadNoise, ModelConfig};
use rand_chacha::{ChaCha8Rng, rand_core::SeedableRng};

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
