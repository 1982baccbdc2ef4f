//! The parameters of the C51 head, and the one linear layer that they amount to.
//! It applies no layer.
//!
//! Both streams of a dueling head are linear in the same relu(f4), so V + A - mean_a A is a linear layer too, whose weight is made of
//! theirs in the same way; and a noisy layer is mu + sigma * eps before it is anything. The layer is made once a pass, whatever the
//! number of rows, and from there on any head costs what a plain one does: of the actions taken alone if that is all that is asked for.

use candle_core::{D, Tensor};

use crate::config::ModelConfig;
use crate::error::{ModelError, Result};
use crate::heads::config::{ADVANTAGE, HEAD, VALUE};
use crate::heads::noise::HeadNoise;
use crate::parameters::Parameters;

/// Weight [out, in] and bias [out] of a linear layer.
#[derive(Clone, Debug)]
pub(crate) struct LinearLayer {
    pub(crate) weight: Tensor,
    pub(crate) bias: Tensor,
}

/// A layer of the head: what it is without noise, and what scales its noise if it is a noisy one.
#[derive(Debug)]
struct HeadLayer {
    mean: LinearLayer,
    sigma: Option<LinearLayer>,
}

impl HeadLayer {
    fn new(name: &str, config: &ModelConfig, parameters: &Parameters) -> Result<Self> {
        let layer = |end: &str| -> Result<LinearLayer> {
            Ok(LinearLayer {
                weight: parameters.tensor(name, &format!("weight{end}"))?,
                bias: parameters.tensor(name, &format!("bias{end}"))?,
            })
        };
        Ok(if config.head.noisy_sigma.is_some() {
            Self {
                mean: layer("_mu")?,
                sigma: Some(layer("_sigma")?),
            }
        } else {
            Self {
                mean: layer("")?,
                sigma: None,
            }
        })
    }

    /// mu + sigma * eps, of the noise of the head's layer with this number; mu without noise.
    fn with_noise(&self, noise: Option<&HeadNoise>, number: usize) -> Result<LinearLayer> {
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
        Ok(LinearLayer {
            weight: add(&self.mean.weight, &sigma.weight, &weight)?,
            bias: add(&self.mean.bias, &sigma.bias, &bias)?,
        })
    }
}

#[derive(Debug)]
pub(crate) struct Streams {
    /// Of N outputs; there in a dueling head.
    value: Option<HeadLayer>,
    /// Of A * N outputs: the advantage's of a dueling head, else the whole head.
    actions: HeadLayer,
    atoms: usize,
}

impl Streams {
    pub(crate) fn new(config: &ModelConfig, parameters: &Parameters) -> Result<Self> {
        let layer = |name: &str| HeadLayer::new(name, config, parameters);
        let dueling = config.head.dueling;
        Ok(Self {
            value: dueling.then(|| layer(VALUE)).transpose()?,
            actions: layer(if dueling { ADVANTAGE } else { HEAD })?,
            atoms: config.atoms,
        })
    }

    /// The layer of A * N outputs that they amount to with this noise, or without; of a plain head its own, whose parameters then are
    /// variables.
    pub(crate) fn layer(&self, noise: Option<&HeadNoise>) -> Result<LinearLayer> {
        let Some(value) = &self.value else {
            return self.actions.with_noise(noise, 0);
        };
        let value = value.with_noise(noise, 0)?;
        let advantage = self.actions.with_noise(noise, 1)?;
        let (v, a) = (value.bias.unsqueeze(1)?, advantage.bias.unsqueeze(1)?);
        Ok(LinearLayer {
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
