//! The parameters of the C51 head, and their reduction to one linear layer.
//! This module applies no layer.
//!
//! Both streams of a dueling head are linear in the same relu(f4). So V + A - mean_a A is a linear layer too, and its weight is
//! the same combination of the streams' weights. A noisy layer is mu + sigma * eps. The layer is built once a pass, whatever
//! the number of rows. Every head then costs as much as a plain one, also if only the logits of the taken actions are computed.

use candle_core::{D, Tensor};

use crate::config::ModelConfig;
use crate::error::{ModelError, Result};
use crate::heads::noise::HeadNoise;
use crate::layers::Layer;

/// A layer of the head: its mean, and the scale of its noise if it is noisy.
#[derive(Debug)]
pub(crate) struct HeadLayer<T> {
    pub(crate) mean: Layer<T>,
    pub(crate) sigma: Option<Layer<T>>,
}

impl<T> HeadLayer<T> {
    /// Collects the layers of the head of `config`: value and advantage if dueling, else one. `take` returns
    /// a parameter by the layer's name and the parameter's, such as `weight_mu`.
    pub(crate) fn collect(
        config: &ModelConfig,
        mut take: impl FnMut(&str, &str) -> Result<T>,
    ) -> Result<Vec<Self>> {
        let mut layer = |name: &str, suffix: &str| -> Result<Layer<T>> {
            Ok(Layer {
                weight: take(name, &format!("weight{suffix}"))?,
                bias: take(name, &format!("bias{suffix}"))?,
            })
        };
        let (mean, sigma) = match config.head.noisy_sigma {
            None => ("", None),
            Some(_) => ("_mu", Some("_sigma")),
        };
        let layers = config.head_layers().into_iter().map(|(name, _)| {
            Ok(Self {
                mean: layer(name, mean)?,
                sigma: sigma.map(|suffix| layer(name, suffix)).transpose()?,
            })
        });
        layers.collect()
    }
}

impl HeadLayer<Tensor> {
    /// Returns mu + sigma * eps for the head's layer with this index, or mu without noise.
    fn with_noise(&self, noise: Option<&HeadNoise>, index: usize) -> Result<Layer<Tensor>> {
        let (Some(noise), Some(sigma)) = (noise, &self.sigma) else {
            if noise.is_some() {
                let what = "noise for a head without noisy layers";
                return Err(ModelError::Input(what.to_owned()));
            }
            return Ok(self.mean.clone());
        };
        let (weight, bias) = noise.weight_and_bias(index);
        let add = |mean: &Tensor, sigma: &Tensor, noise: &[f64]| -> Result<Tensor> {
            let noise: Vec<f32> = noise.iter().map(|&it| it as f32).collect();
            let noise = Tensor::from_vec(noise, sigma.dims(), sigma.device())?;
            Ok((mean + (sigma * noise)?)?)
        };
        Ok(Layer {
            weight: add(&self.mean.weight, &sigma.weight, &weight)?,
            bias: add(&self.mean.bias, &sigma.bias, &bias)?,
        })
    }
}

/// Merges a head's `layers` into one layer of A * N outputs, with or without noise. For a plain head without noise, this is the
/// head's layer itself, whose parameters are variables.
pub(crate) fn merge(
    layers: &[HeadLayer<Tensor>],
    atoms: usize,
    noise: Option<&HeadNoise>,
) -> Result<Layer<Tensor>> {
    let first = layers[0].with_noise(noise, 0)?;
    let Some(advantage) = layers.get(1) else {
        return Ok(first);
    };
    let (value, advantage) = (first, advantage.with_noise(noise, 1)?);
    let (v, a) = (value.bias.unsqueeze(1)?, advantage.bias.unsqueeze(1)?);
    Ok(Layer {
        weight: add_streams(&value.weight, &advantage.weight, atoms)?,
        bias: add_streams(&v, &a, atoms)?.squeeze(D::Minus1)?,
    })
}

/// Computes V + A - mean_a A of outputs: `value` [N, in], `advantage` [A * N, in], result [A * N, in].
///
/// Source: Wang et al. 2016, equation 9, per atom.
fn add_streams(value: &Tensor, advantage: &Tensor, atoms: usize) -> candle_core::Result<Tensor> {
    let (outputs, inputs) = advantage.dims2()?;
    let by_action = advantage.reshape((outputs / atoms, atoms, inputs))?;
    let shared = (value - by_action.mean(0)?)?;
    by_action
        .broadcast_add(&shared.unsqueeze(0)?)?
        .reshape((outputs, inputs))
}

/// [`merge`] for an actor, without a graph.
pub(crate) fn merge_values(
    layers: &[HeadLayer<Vec<f32>>],
    noise: Option<&HeadNoise>,
) -> Layer<Vec<f32>> {
    let with_noise = |(index, layer): (usize, &HeadLayer<Vec<f32>>)| {
        let mut sum = layer.mean.clone();
        if let (Some(noise), Some(sigma)) = (noise, &layer.sigma) {
            let noise = &noise.layers[index];
            let narrow = |noise: &[f64]| noise.iter().map(|&it| it as f32).collect::<Vec<_>>();
            let (inputs, outputs) = (narrow(&noise.inputs), narrow(&noise.outputs));
            let rows = sum.weight.chunks_exact_mut(inputs.len());
            let sigmas = sigma.weight.chunks_exact(inputs.len());
            for ((row, sigma), output) in rows.zip(sigmas).zip(&outputs) {
                for ((w, sigma), input) in row.iter_mut().zip(sigma).zip(&inputs) {
                    *w += sigma * (input * output);
                }
            }
            let biases = sum.bias.iter_mut().zip(&sigma.bias);
            for ((b, sigma), output) in biases.zip(&outputs) {
                *b += sigma * output;
            }
        }
        sum
    };
    let mut layers = layers.iter().enumerate().map(with_noise);
    let first = layers.next().expect("a head has a layer");
    let Some(mut advantage) = layers.next() else {
        return first;
    };
    add_stream_values(&first.weight, &mut advantage.weight);
    add_stream_values(&first.bias, &mut advantage.bias);
    advantage
}

/// Computes V + A - mean_a A in `advantage` [A * N, in] or [A * N], from `value` [N, in] or [N].
fn add_stream_values(value: &[f32], advantage: &mut [f32]) {
    let mut shared = vec![0.0; value.len()];
    for action in advantage.chunks_exact(value.len()) {
        for (sum, a) in shared.iter_mut().zip(action) {
            *sum += a;
        }
    }
    let actions = (advantage.len() / value.len()) as f32;
    for (shared, v) in shared.iter_mut().zip(value) {
        *shared = v - *shared / actions;
    }
    for action in advantage.chunks_exact_mut(value.len()) {
        for (a, shared) in action.iter_mut().zip(&shared) {
            *a += shared;
        }
    }
}
