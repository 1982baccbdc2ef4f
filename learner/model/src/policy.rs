//! The network as an actor uses it: frames to expected returns and greedy actions, without a graph.
//! It does not explore, and it holds no DIM head.
//!
//! This module runs the same kernels as `Network`. It splits the batch over the rayon pool once, not layer by
//! layer, so that a task's maps stay in its core's cache.

use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;

use crate::config::ModelConfig;
use crate::error::{ModelError, Result};
use crate::heads::c51::expected_returns;
use crate::heads::noise::HeadNoise;
use crate::heads::streams::{HeadLayer, merge_values};
use crate::kernels::dense::{ReluLayer, build_relu_layer};
use crate::kernels::precision::Precision;
use crate::parameters::{decode, is_dim};
use crate::torso::interface::{ActingTorso, TorsoParameters};

/// Frames that one thread passes through the network together.
const TILE_FRAMES: usize = 32;

/// Torso and C51 head for inference.
pub struct PolicyNetwork {
    config: ModelConfig,
    support: Vec<f32>,
    precision: Precision,
    weights: Weights,
}

impl PolicyNetwork {
    /// Builds the network of `config` from the bytes of a safetensors file, ignoring DIM parameters.
    /// `precision` is the precision of its matrix products.
    pub fn new(config: &ModelConfig, safetensors: &[u8], precision: Precision) -> Result<Self> {
        let config = config.without_dim();
        let weights = Weights::decode(&config, safetensors, precision)?;
        Ok(Self {
            support: config.atoms_support(),
            config,
            precision,
            weights,
        })
    }

    /// Replaces the weights. On an error the old ones stay.
    pub fn load(&mut self, safetensors: &[u8]) -> Result<()> {
        self.weights = Weights::decode(&self.config, safetensors, self.precision)?;
        Ok(())
    }

    /// Draws new noise for the head's noisy layers and uses it until the next draw or [`load`](Self::load). Before
    /// the first draw, and after a load, the layers use their means. Draws nothing if no layer is noisy.
    pub fn draw_noise(&mut self, rng: &mut ChaCha8Rng) {
        let noise = HeadNoise::draw(&self.config, rng);
        if noise.is_some() {
            self.set_noise(noise.as_ref());
        }
    }

    /// Uses this noise in the head's noisy layers from now on. `None` means the layers' means.
    pub fn set_noise(&mut self, noise: Option<&HeadNoise>) {
        let weights = &mut self.weights;
        if let Some(noisy) = &weights.noisy_layers {
            weights.head = build_relu_layer(self.precision, merge_values(noisy, noise));
        }
    }

    /// Computes the expected returns `values` [B, A] of `frames` [B, H, W, C].
    ///
    /// # Errors
    /// [`ModelError::Input`] if the lengths do not match; [`ModelError::NotFinite`] if a value is not finite.
    pub fn q_values(&mut self, frames: &[u8], values: &mut [f32]) -> Result<()> {
        let (frame_len, actions) = (self.config.frame_len(), self.config.num_actions);
        let batch = values.len() / actions;
        if values.len() != batch * actions || frames.len() != batch * frame_len {
            let (bytes, count) = (frames.len(), values.len());
            return Err(ModelError::Input(format!(
                "{bytes} bytes of frames of {frame_len} for {count} values of {actions} actions"
            )));
        }
        let tasks = rayon::current_num_threads().min(batch);
        let (weights, support) = (&self.weights, &self.support);
        let task = |frames: &[u8], values: &mut [f32]| {
            let frames = frames.chunks(TILE_FRAMES * frame_len);
            for (frames, values) in frames.zip(values.chunks_mut(TILE_FRAMES * actions)) {
                let hidden = (weights.torso)(frames);
                let logits = (weights.head)(&hidden);
                expected_returns(&logits, support, values);
            }
        };
        if tasks <= 1 {
            task(frames, values);
        } else {
            let task_frames = batch.div_ceil(tasks);
            let values = values.par_chunks_mut(task_frames * actions);
            let frames = frames.par_chunks(task_frames * frame_len);
            values
                .zip(frames)
                .for_each(|(values, frames)| task(frames, values));
        }
        let bad = values.iter().position(|value| !value.is_finite());
        match bad.map(|index| index / actions) {
            Some(row) => Err(ModelError::NotFinite { row }),
            None => Ok(()),
        }
    }

    /// Writes the greedy action of each frame in `frames` [B, H, W, C] to `actions` [B]. On a tie the lowest action wins.
    pub fn greedy_actions(&mut self, frames: &[u8], actions: &mut [u8]) -> Result<()> {
        let count = self.config.num_actions;
        let mut values = vec![0.0; actions.len() * count];
        self.q_values(frames, &mut values)?;
        for (action, values) in actions.iter_mut().zip(values.chunks_exact(count)) {
            *action = argmax(values);
        }
        Ok(())
    }
}

/// Returns the action of the largest of `values` [A]. On a tie the lowest action wins.
pub fn argmax(values: &[f32]) -> u8 {
    let better = |best: usize, at: usize| if values[at] > values[best] { at } else { best };
    let best = (1..values.len()).fold(0, better);
    u8::try_from(best).expect("a valid configuration has at most 255 actions")
}

/// Weights laid out for the fastest instruction set of this processor.
struct Weights {
    torso: ActingTorso,
    head: ReluLayer,
    /// The layers that `head` is merged from, kept to merge them with new noise. `Some` if the head is noisy.
    noisy_layers: Option<Vec<HeadLayer<Vec<f32>>>>,
}

impl Weights {
    /// Decodes the weights in the bytes of a safetensors file.
    fn decode(config: &ModelConfig, safetensors: &[u8], precision: Precision) -> Result<Self> {
        let mut parameters = decode(config, |_| true, safetensors, is_dim)?;
        let mut take = |layer: &str, part: &str| -> Result<Vec<f32>> {
            let name = format!("{layer}.{part}");
            let missing = || ModelError::parameter(&name, "is missing");
            let (_, values) = parameters.remove(&name).ok_or_else(missing)?;
            Ok(values)
        };
        let torso = config.torso();
        let torso_parameters = TorsoParameters::collect(&*torso, &mut take)?;
        let head_layers = HeadLayer::collect(config, take)?;
        Ok(Self {
            torso: torso.for_actor(precision, torso_parameters),
            head: build_relu_layer(precision, merge_values(&head_layers, None)),
            noisy_layers: config.head.noisy_sigma.map(|_| head_layers),
        })
    }
}
