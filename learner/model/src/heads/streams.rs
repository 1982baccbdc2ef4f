//! The parameters of the C51 head, and the one linear layer that they amount to.
//! It applies no layer.
//!
//! Both streams of a dueling head are linear in the same relu(f4), so V + A - mean_a A is a linear layer too, whose weight is made of
//! theirs in the same way; and a noisy layer is mu + sigma * eps before it is anything. The layer is made once a pass, whatever the
//! number of rows, and from there on any head costs what a plain one does: of the actions taken alone if that is all that is asked for.

use candle_core::{D, Tensor};

use crate::config::ModelConfig;
use crate::error::{ModelError, Result};
use crate::heads::noise::HeadNoise;
use crate::layers::Layer;
use crate::parameters::Parameters;

/// A layer of the head: what it is without noise, and what scales its noise if it is a noisy one.
#[derive(Debug)]
pub(crate) struct HeadLayer<T> {
    pub(crate) mean: Layer<T>,
    pub(crate) sigma: Option<Layer<T>>,
}

impl<T> HeadLayer<T> {
    /// The layers of the head of `config`: the value's and the advantage's of a dueling head, else one. `take` gives a parameter by
    /// its layer's name and its own.
    pub(crate) fn all<E>(
        config: &ModelConfig,
        mut take: impl FnMut(&str, &str) -> std::result::Result<T, E>,
    ) -> std::result::Result<Vec<Self>, E> {
        let mut layer = |name: &str, end: &str| -> std::result::Result<Layer<T>, E> {
            Ok(Layer {
                weight: take(name, &format!("weight{end}"))?,
                bias: take(name, &format!("bias{end}"))?,
            })
        };
        let (mean, sigma) = match config.head.noisy_sigma {
            None => ("", None),
            Some(_) => ("_mu", Some("_sigma")),
        };
        let layers = config.head_layers().into_iter().map(|(name, _)| {
            Ok(Self {
                mean: layer(name, mean)?,
                sigma: sigma.map(|end| layer(name, end)).transpose()?,
            })
        });
        layers.collect()
    }
}

impl HeadLayer<Tensor> {
    /// mu + sigma * eps, of the noise of the head's layer with this number; mu without noise.
    fn with_noise(&self, noise: Option<&HeadNoise>, number: usize) -> Result<Layer<Tensor>> {
        let (Some(noise), Some(sigma)) = (noise, &self.sigma) else {
            if noise.is_some() {
                let what = "noise for a head without noisy layers";
                return Err(ModelError::Input(what.to_owned()));
            }
            return Ok(self.mean.clone());
        };
        let (weight, bias) = noise.of_parameters(number);
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

#[derive(Debug)]
pub(crate) struct Streams {
    layers: Vec<HeadLayer<Tensor>>,
    atoms: usize,
}

impl Streams {
    pub(crate) fn new(config: &ModelConfig, parameters: &Parameters) -> Result<Self> {
        Ok(Self {
            layers: HeadLayer::all(config, |layer, part| parameters.tensor(layer, part))?,
            atoms: config.atoms,
        })
    }

    /// The layer of A * N outputs that they amount to with this noise, or without; of a plain head its own, whose parameters then are
    /// variables.
    pub(crate) fn layer(&self, noise: Option<&HeadNoise>) -> Result<Layer<Tensor>> {
        let first = self.layers[0].with_noise(noise, 0)?;
        let Some(advantage) = self.layers.get(1) else {
            return Ok(first);
        };
        let (value, advantage) = (first, advantage.with_noise(noise, 1)?);
        let (v, a) = (value.bias.unsqueeze(1)?, advantage.bias.unsqueeze(1)?);
        Ok(Layer {
            weight: dueling(&value.weight, &advantage.weight, self.atoms)?,
            bias: dueling(&v, &a, self.atoms)?.squeeze(D::Minus1)?,
        })
    }
}

/// V + A - mean_a A of outputs: `value` [N, in], `advantage` [A * N, in], result [A * N, in].
///
/// Source: Wang et al. 2016, equation 9, for each atom.
fn dueling(value: &Tensor, advantage: &Tensor, atoms: usize) -> candle_core::Result<Tensor> {
    let (outputs, inputs) = advantage.dims2()?;
    let by_action = advantage.reshape((outputs / atoms, atoms, inputs))?;
    let shared = (value - by_action.mean(0)?)?;
    by_action
        .broadcast_add(&shared.unsqueeze(0)?)?
        .reshape((outputs, inputs))
}
