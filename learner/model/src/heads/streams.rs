//! The parameters of the C51 head, and the one linear layer that they amount to.
//! It applies no layer.
//!
//! Both streams of a dueling head are linear in the same relu(f4), so V + A - mean_a A is a linear layer too, whose weight is made of
//! theirs in the same way. It is made once a pass, whatever the number of rows, and from there on a dueling head costs what a plain
//! one does: of the actions taken alone if that is all that is asked for.

use candle_core::{D, Tensor};

use crate::config::ModelConfig;
use crate::error::Result;
use crate::parameters::Parameters;

/// Name of the head, and of its streams if it is a dueling one.
pub(crate) const HEAD: &str = "head";
pub(crate) const VALUE: &str = "head.value";
pub(crate) const ADVANTAGE: &str = "head.advantage";

/// Weight [A * N, in] and bias [A * N] of a linear layer.
#[derive(Clone, Debug)]
pub(crate) struct LinearLayer {
    pub(crate) weight: Tensor,
    pub(crate) bias: Tensor,
}

/// The head's parameters.
#[derive(Debug)]
pub(crate) enum Streams {
    One(LinearLayer),
    Dueling {
        /// Of N outputs.
        value: LinearLayer,
        /// Of A * N outputs.
        advantage: LinearLayer,
        atoms: usize,
    },
}

impl Streams {
    pub(crate) fn new(config: &ModelConfig, parameters: &Parameters) -> Result<Self> {
        let layer = |name: &str| -> Result<LinearLayer> {
            Ok(LinearLayer {
                weight: parameters.tensor(name, "weight")?,
                bias: parameters.tensor(name, "bias")?,
            })
        };
        Ok(if config.head.dueling {
            Self::Dueling {
                value: layer(VALUE)?,
                advantage: layer(ADVANTAGE)?,
                atoms: config.atoms,
            }
        } else {
            Self::One(layer(HEAD)?)
        })
    }

    /// The layer that they amount to; of a plain head its own, whose parameters then are variables.
    pub(crate) fn layer(&self) -> Result<LinearLayer> {
        match self {
            Self::One(layer) => Ok(layer.clone()),
            Self::Dueling {
                value,
                advantage,
                atoms,
            } => Ok(LinearLayer {
                weight: dueling(&value.weight, &advantage.weight, *atoms)?,
                bias: dueling(
                    &value.bias.unsqueeze(1)?,
                    &advantage.bias.unsqueeze(1)?,
                    *atoms,
                )?
                .squeeze(D::Minus1)?,
            }),
        }
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

/// The same for one input of weights [in, out], or for a bias: `value` [N], `advantage` [A * N], which becomes the result.
pub(crate) fn duel(value: &[f32], advantage: &mut [f32]) {
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
