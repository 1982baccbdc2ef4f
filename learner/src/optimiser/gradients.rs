//! The gradients of one loss: the backward pass, the global norm, and the factor that clips them.
//! It changes no parameter; `adam` does.

use std::collections::BTreeMap;

use candle_core::{DType, Tensor};
use driml_model::{Kernels, Parameters, backward, values_of};
use rayon::prelude::*;

use crate::error::{Result, UpdateError};

/// Elements that a thread sums at a time.
const CHUNK: usize = 1 << 14;

/// Largest relative error of the norm of up to ten million gradients. 2,048 additions within a chunk and 640 across chunks may each lose
/// half a unit in the last place of an f64 in the same direction; the root halves the relative error.
pub const NORM_ERROR: f64 = 1.5e-13;

/// Gradients of one loss, by parameter name. A parameter that the loss does not touch has none.
#[derive(Debug)]
pub struct Gradients {
    by_name: BTreeMap<String, Tensor>,
}

impl Gradients {
    /// Computes the gradients of the scalar `loss` by `parameters`.
    pub fn compute(parameters: &Parameters, loss: &Tensor) -> Result<Self> {
        Ok(Self {
            by_name: backward(loss, parameters.iter())?,
        })
    }

    /// The gradient of a parameter, if the loss touches it.
    pub fn get(&self, name: &str) -> Option<&Tensor> {
        self.by_name.get(name)
    }

    /// Global 2-norm of all gradients together, accumulated in f64: accurate to [`NORM_ERROR`] for any finite gradients on the CPU.
    ///
    /// # Errors
    /// [`UpdateError::NonFinite`] with the first parameter whose gradient is infinite or NaN.
    pub fn norm(&self, kernels: Kernels) -> Result<f64> {
        let squares: Vec<f64> = match kernels {
            Kernels::Fused(_) => {
                let per_tensor = self.by_name.values().map(squares_on_cpu);
                per_tensor.collect::<Result<_, _>>()?
            }
            Kernels::Candle => {
                let squares = |g: &Tensor| g.to_dtype(DType::F64)?.sqr()?.sum_all();
                let per_tensor = self.by_name.values().map(squares);
                let per_tensor = per_tensor.collect::<candle_core::Result<Vec<_>>>()?;
                // One copy to the host, not one per parameter.
                Tensor::stack(&per_tensor, 0)?.to_vec1()?
            }
        };
        let bad = self.by_name.keys().zip(&squares);
        if let Some((name, _)) = bad.into_iter().find(|(_, it)| !it.is_finite()) {
            return Err(UpdateError::NonFinite(format!("the gradient of {name}")));
        }
        Ok(squares.iter().sum::<f64>().sqrt())
    }
}

/// Sum of the squares of a tensor on the CPU.
fn squares_on_cpu(tensor: &Tensor) -> candle_core::Result<f64> {
    let values = values_of(tensor)?;
    let parts = values.par_chunks(CHUNK).map(sum_of_squares);
    // Summed in order, so that the result does not depend on the threads.
    Ok(parts.collect::<Vec<f64>>().iter().sum())
}

/// Sum of squares in f64, in eight interleaved parts so that it runs at the speed of memory.
fn sum_of_squares(values: &[f32]) -> f64 {
    let mut parts = [0f64; 8];
    let chunks = values.chunks_exact(8);
    let rest = chunks.remainder().iter();
    let rest: f64 = rest.map(|&x| f64::from(x) * f64::from(x)).sum();
    for chunk in chunks {
        for (part, &x) in parts.iter_mut().zip(chunk) {
            *part += f64::from(x) * f64::from(x);
        }
    }
    parts.iter().sum::<f64>() + rest
}

/// Computes the factor that limits the norm of gradients of global norm `norm` to `max_norm`.
///
/// The factor is `max_norm / (norm + 1e-6)`, and at most 1. Adam uses it as an f32, which has full precision for norms up to 8e37
/// times `max_norm`. Source: PyTorch's `clip_grad_norm_`.
pub fn clip_factor(norm: f64, max_norm: f64) -> f64 {
    (max_norm / (norm + 1e-6)).min(1.0)
}
