//! The C51 head's parameters as an actor holds them, and the one linear layer that they amount to: `streams` without a graph.
//! It applies no layer.

use crate::heads::noise::HeadNoise;
use crate::heads::streams::HeadLayer;
use crate::layers::Layer;

/// The head's layers, with weights [in, out].
pub(crate) struct ActingHead {
    layers: Vec<HeadLayer<Vec<f32>>>,
}

impl ActingHead {
    /// The head of `layers`, with weights [out, in].
    pub(crate) fn new(layers: Vec<HeadLayer<Vec<f32>>>) -> Self {
        let inputs_first = |layer: Layer<Vec<f32>>| Layer {
            weight: transposed(&layer.weight, layer.bias.len()),
            bias: layer.bias,
        };
        let layers = layers.into_iter().map(|layer| HeadLayer {
            mean: inputs_first(layer.mean),
            sigma: layer.sigma.map(inputs_first),
        });
        Self {
            layers: layers.collect(),
        }
    }

    /// The layer of A * N outputs that they amount to with this noise, or without; weight [in, out].
    pub(crate) fn layer(&self, noise: Option<&HeadNoise>) -> Layer<Vec<f32>> {
        let with_noise = |(number, layer): (usize, &HeadLayer<Vec<f32>>)| {
            let mut sum = layer.mean.clone();
            if let (Some(noise), Some(sigma)) = (noise, &layer.sigma) {
                let noise = noise.of_layer(number);
                let narrow = |noise: &[f64]| noise.iter().map(|&it| it as f32).collect::<Vec<_>>();
                let (inputs, outputs) = (narrow(&noise.inputs), narrow(&noise.outputs));
                let rows = sum.weight.chunks_exact_mut(sum.bias.len());
                let sigmas = sigma.weight.chunks_exact(sum.bias.len());
                for ((row, sigma), input) in rows.zip(sigmas).zip(&inputs) {
                    for ((w, sigma), output) in row.iter_mut().zip(sigma).zip(&outputs) {
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
        let mut layers = self.layers.iter().enumerate().map(with_noise);
        let first = layers.next().expect("a head has a layer");
        let Some(mut advantage) = layers.next() else {
            return first;
        };
        let value = first;
        let rows = advantage.weight.chunks_exact_mut(advantage.bias.len());
        for (row, value) in rows.zip(value.weight.chunks_exact(value.bias.len())) {
            duel(value, row);
        }
        duel(&value.bias, &mut advantage.bias);
        advantage
    }
}

/// V + A - mean_a A of one input's weights, or of the biases: `value` [N], `advantage` [A * N], which becomes the result.
fn duel(value: &[f32], advantage: &mut [f32]) {
    let atoms = value.len();
    let mut shared = vec![0.0; atoms];
    for action in advantage.chunks_exact(atoms) {
        for (sum, a) in shared.iter_mut().zip(action) {
            *sum += a;
        }
    }
    let actions = (advantage.len() / atoms) as f32;
    for (shared, v) in shared.iter_mut().zip(value) {
        *shared = v - *shared / actions;
    }
    for action in advantage.chunks_exact_mut(atoms) {
        for (a, shared) in action.iter_mut().zip(&shared) {
            *a += shared;
        }
    }
}

/// A weight [out, in] as [in, out].
fn transposed(weight: &[f32], outputs: usize) -> Vec<f32> {
    let inputs = weight.len() / outputs;
    let mut result = Vec::with_capacity(weight.len());
    for input in 0..inputs {
        result.extend((0..outputs).map(|output| weight[output * inputs + input]));
    }
    result
}
