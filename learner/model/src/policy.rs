//! The network as an actor uses it: frames to expected returns and greedy actions, without a graph.
//! It does not explore, and it holds no DIM head.
//!
//! It runs the same kernels as `Network`. The batch is split over the rayon pool once, not layer by layer, so that a
//! task's maps stay in its core's cache.

use std::fmt;

use rayon::prelude::*;

use crate::c51_head::expected_returns;
use crate::config::ModelConfig;
use crate::error::{ModelError, Result};
use crate::gemm::Matrix;
use crate::geometry::ConvShape;
use crate::im2col::{ConvScratch, Images, forward, grown};
use crate::linear::{self, relu_in_place};
use crate::weights::{decode, is_dim};

/// Frames that go through the network together on one thread.
const TILE_FRAMES: usize = 32;

/// Torso and C51 head for inference.
pub struct PolicyNetwork {
    config: ModelConfig,
    support: Vec<f32>,
    weights: PolicyWeights,
    /// One a task.
    scratch: Vec<Scratch>,
    values: Vec<f32>,
}

impl PolicyNetwork {
    /// The network of `config` with the weights of a safetensors file; DIM parameters in it are ignored.
    ///
    /// # Errors
    /// An invalid configuration, bytes that are not safetensors, or a parameter that is missing, unknown, of another type
    /// or shape, or not finite.
    pub fn new(config: &ModelConfig, safetensors: &[u8]) -> Result<Self> {
        let config = config.without_dim();
        let weights = PolicyWeights::decode(&config, safetensors)?;
        Ok(Self {
            support: config.atoms_support(),
            config,
            weights,
            scratch: Vec::new(),
            values: Vec::new(),
        })
    }

    /// Replaces the weights. On an error the old ones stay.
    ///
    /// # Errors
    /// As for [`PolicyNetwork::new`].
    pub fn load(&mut self, safetensors: &[u8]) -> Result<()> {
        self.weights = PolicyWeights::decode(&self.config, safetensors)?;
        Ok(())
    }

    /// Expected returns `values` [B, A] of `frames` [B, H, W, C].
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
        if self.scratch.len() < tasks {
            self.scratch.resize_with(tasks, Scratch::default);
        }
        let (weights, support) = (&self.weights, &self.support);
        if tasks <= 1 {
            if let Some(scratch) = self.scratch.first_mut() {
                weights.q_values(support, frames, values, scratch);
            }
        } else {
            let share = batch.div_ceil(tasks);
            let values = values.par_chunks_mut(share * actions);
            let frames = frames.par_chunks(share * frame_len);
            values
                .zip(frames)
                .zip(&mut self.scratch)
                .for_each(|((values, frames), scratch)| {
                    weights.q_values(support, frames, values, scratch);
                });
        }
        match values.iter().position(|value| !value.is_finite()) {
            Some(index) => Err(ModelError::NotFinite {
                row: index / actions,
            }),
            None => Ok(()),
        }
    }

    /// Writes the action of largest expected return, the lowest on a tie, for each of `frames` [B, H, W, C] to
    /// `actions` [B].
    ///
    /// # Errors
    /// As for [`PolicyNetwork::q_values`].
    pub fn greedy_actions(&mut self, frames: &[u8], actions: &mut [u8]) -> Result<()> {
        let count = self.config.num_actions;
        let mut values = std::mem::take(&mut self.values);
        values.resize(actions.len() * count, 0.0);
        let result = self.q_values(frames, &mut values);
        if result.is_ok() {
            for (action, values) in actions.iter_mut().zip(values.chunks_exact(count)) {
                let better = |best: usize, next: usize| {
                    if values[next] > values[best] {
                        next
                    } else {
                        best
                    }
                };
                let best = (1..count).fold(0, better);
                *action =
                    u8::try_from(best).expect("a valid configuration has at most 255 actions");
            }
        }
        self.values = values;
        result
    }
}

impl fmt::Debug for PolicyNetwork {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("PolicyNetwork")
            .field("config", &self.config)
            .finish_non_exhaustive()
    }
}

/// Weights as the kernels want them.
struct PolicyWeights {
    convolutions: Vec<Convolution>,
    fc: Dense,
    head: Dense,
}

struct Convolution {
    shape: ConvShape,
    packed: Vec<f32>,
    bias: Vec<f32>,
}

/// A fully connected layer with its weight as [in, out].
struct Dense {
    weight: Vec<f32>,
    bias: Vec<f32>,
}

/// Buffers that one task keeps between calls.
#[derive(Default)]
struct Scratch {
    conv: ConvScratch,
    maps: Vec<f32>,
    next_maps: Vec<f32>,
    hidden: Vec<f32>,
    logits: Vec<f32>,
}

impl PolicyWeights {
    fn decode(config: &ModelConfig, safetensors: &[u8]) -> Result<Self> {
        let mut parameters = decode(config, |_| true, safetensors, is_dim)?;
        let mut take = |name: &str| {
            let (_, values) = parameters
                .remove(name)
                .expect("decode returns every parameter of the configuration");
            values
        };
        let convolutions = (1..)
            .zip(config.conv_shapes())
            .map(|(number, shape)| Convolution {
                shape,
                packed: shape.pack_weight(&take(&format!("torso.conv{number}.weight"))),
                bias: take(&format!("torso.conv{number}.bias")),
            });
        let convolutions = convolutions.collect();
        let (height, width, channels) = config.local_shape();
        // The inputs in our maps' order, row, column, channel, instead of PyTorch's channel, row, column.
        let column = |input: usize| input % channels * height * width + input / channels;
        let fc_weight = transposed(&take("torso.fc.weight"), config.hidden, column);
        let fc = Dense {
            weight: fc_weight,
            bias: take("torso.fc.bias"),
        };
        let head_weight = transposed(
            &take("head.weight"),
            config.num_actions * config.atoms,
            |input| input,
        );
        let head = Dense {
            weight: head_weight,
            bias: take("head.bias"),
        };
        Ok(Self {
            convolutions,
            fc,
            head,
        })
    }

    fn q_values(&self, support: &[f32], frames: &[u8], values: &mut [f32], scratch: &mut Scratch) {
        let frame_len = self
            .convolutions
            .first()
            .map_or(1, |first| first.shape.image_len());
        let actions = self.head.bias.len() / support.len();
        let tiles = frames
            .chunks(TILE_FRAMES * frame_len)
            .zip(values.chunks_mut(TILE_FRAMES * actions));
        for (frames, values) in tiles {
            self.tile_q_values(support, frames, values, scratch);
        }
    }

    fn tile_q_values(
        &self,
        support: &[f32],
        frames: &[u8],
        values: &mut [f32],
        scratch: &mut Scratch,
    ) {
        let Scratch {
            conv,
            maps,
            next_maps,
            hidden,
            logits,
        } = scratch;
        let batch = values.len() * support.len() / self.head.bias.len();
        for (
            index,
            Convolution {
                shape,
                packed,
                bias,
            },
        ) in self.convolutions.iter().enumerate()
        {
            let images = match index {
                0 => Images::Bytes(frames),
                _ => Images::Floats(&maps[..batch * shape.image_len()]),
            };
            forward(
                shape,
                images,
                packed,
                bias,
                grown(next_maps, batch * shape.map_len()),
                conv,
            );
            std::mem::swap(maps, next_maps);
        }
        let flat = self.fc.weight.len() / self.fc.bias.len();
        let hidden = self.fc.forward(&maps[..batch * flat], batch, hidden);
        relu_in_place(hidden);
        let logits = self.head.forward(hidden, batch, logits);
        expected_returns(logits, support, values);
    }
}

impl Dense {
    fn forward<'a>(&self, x: &[f32], batch: usize, y: &'a mut Vec<f32>) -> &'a mut [f32] {
        let outputs = self.bias.len();
        let inputs = self.weight.len() / outputs;
        let y = grown(y, batch * outputs);
        linear::forward(
            Matrix::new(x, batch, inputs),
            Matrix::new(&self.weight, inputs, outputs),
            &self.bias,
            y,
        );
        y
    }
}

/// A weight [out, in] as [in, out], whose input i is column `column(i)` of the original.
fn transposed(weight: &[f32], outputs: usize, column: impl Fn(usize) -> usize) -> Vec<f32> {
    let inputs = weight.len() / outputs;
    let mut result = Vec::with_capacity(weight.len());
    for input in 0..inputs {
        result.extend((0..outputs).map(|output| weight[output * inputs + column(input)]));
    }
    result
}
