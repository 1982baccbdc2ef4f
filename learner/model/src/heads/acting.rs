//! Reduces a C51 head to one linear layer for an actor, without a graph. `streams` does the same with gradients.
//! This module applies no layer.

use crate::heads::noise::HeadNoise;
use crate::heads::streams::HeadLayer;
use crate::layers::Layer;

/// Merges a head's `layers` into one layer of A * N outputs. Without `noise`, noisy layers are their means.
pub(crate) fn merge(layers: &[HeadLayer<Vec<f32>>], noise: Option<&HeadNoise>) -> Layer<Vec<f32>> {
    let with_noise = |(index, layer): (usize, &HeadLayer<Vec<f32>>)| {
        let mut sum = layer.mean.clone();
        if let (Some(noise), Some(sigma)) = (noise, &layer.sigma) {
            let noise = noise.layer(index);
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
    add_streams(&first.weight, &mut advantage.weight);
    add_streams(&first.bias, &mut advantage.bias);
    advantage
}

/// Computes V + A - mean_a A in `advantage` [A * N, in] or [A * N], from `value` [N, in] or [N].
fn add_streams(value: &[f32], advantage: &mut [f32]) {
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
