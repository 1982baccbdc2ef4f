//! The noise of the head's noisy layers in an update: made of the run's seed and the number of the update.
//! So it has no state, and a resumed run draws the same noise.

use driml_model::{HeadNoise, ModelConfig};
use rand_chacha::{ChaCha8Rng, rand_core::SeedableRng};

/// The noise of one update, a separate draw for each use of the head, the same for all rows of the batch. None of a head without noisy
/// layers, and none for means.
///
/// Source: Fortunato et al. 2018, algorithm 1, with its third noise for the choice of the action by double DQN.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct UpdateNoise {
    /// Of the online network in s_t.
    pub online: Option<HeadNoise>,
    /// Of the online network where it chooses an action in s_{t+n}, with double DQN.
    pub choice: Option<HeadNoise>,
    /// Of the target network.
    pub target: Option<HeadNoise>,
}

impl UpdateNoise {
    /// That of the update after this many; the same for the same seed.
    pub fn draw(model: &ModelConfig, seed: [u8; 32], updates: u64) -> Self {
        // A generator by counting: update and position are what it is a function of.
        let mut rng = ChaCha8Rng::from_seed(seed);
        rng.set_stream(updates);
        let mut noise = || HeadNoise::draw(model, &mut rng);
        Self {
            online: noise(),
            choice: noise(),
            target: noise(),
        }
    }
}
