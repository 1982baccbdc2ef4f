//! The values of a C51 head: the expectation of each action's distribution over the atoms.
//! This module computes no loss and no projection.
//!
//! Source: Bellemare et al. 2017.

use candle_core::{D, Result, Tensor, bail};
use candle_nn::ops::softmax;
use rayon::prelude::*;

use crate::compute::Kernels;
use crate::kernels::exponentials::exp_minus_max;
use crate::kernels::tensors::values_of;

/// Distributions that one task processes.
const TASK_DISTRIBUTIONS: usize = 256;

/// Computes the expected returns [B, A] of logits [B, A, atoms] over the atoms `support`, without a gradient.
pub(crate) fn q_values(kernels: Kernels, logits: &Tensor, support: &[f32]) -> Result<Tensor> {
    match kernels {
        Kernels::Fused(_) => fused_q_values(&logits.contiguous()?, support),
        Kernels::Candle => {
            let (v_min, spacing) = v_min_and_spacing(support);
            let positions = Tensor::arange(0f32, support.len() as f32, logits.device())?;
            let probs = softmax(&logits.detach(), D::Minus1)?;
            let mean = probs.broadcast_mul(&positions)?.sum(D::Minus1)?;
            mean.affine(spacing, v_min)
        }
    }
}

/// Computes [`expected_returns`] [B, A] of logits [B, A, atoms] on the rayon pool.
fn fused_q_values(logits: &Tensor, support: &[f32]) -> Result<Tensor> {
    let (batch, actions, atoms) = logits.dims3()?;
    if atoms != support.len() {
        bail!("logits {:?} over {} atoms", logits.shape(), support.len());
    }
    let mut values = vec![0.0; batch * actions];
    values
        .par_chunks_mut(TASK_DISTRIBUTIONS)
        .zip(values_of(logits)?.par_chunks(TASK_DISTRIBUTIONS * atoms))
        .for_each(|(values, logits)| expected_returns(logits, support, values));
    Tensor::from_vec(values, (batch, actions), logits.device())
}

/// Largest error of an expected return beyond its f32 rounding, relative to the support's width. It comes
/// from f64 sums over up to a thousand atoms.
pub const EXPECTED_RETURN_ERROR: f64 = 8e-15;

/// Expectation of softmax(logits) over equally spaced atoms: z_0 + spacing * sum_i w_i i / sum_i w_i with w_i = exp(l_i - max l).
///
/// `logits` [n, atoms]; `support` [atoms], of which only the ends and the length matter; `values` [n]. The sum is over atom indices,
/// not returns. So the error beyond f32 rounding is at most [`EXPECTED_RETURN_ERROR`] times the support's width, wherever the support
/// lies. Every value lies within the support, and no f32 support overflows. A NaN, or a maximum that is infinite, gives NaN.
pub(crate) fn expected_returns(logits: &[f32], support: &[f32], values: &mut [f32]) {
    let (v_min, spacing) = v_min_and_spacing(support);
    let v_max = f64::from(support[support.len() - 1]);
    let mut weights = vec![0.0; support.len()];
    for (value, logits) in values.iter_mut().zip(logits.chunks_exact(support.len())) {
        let max = logits.iter().copied().fold(f32::NEG_INFINITY, f32::max);
        for (weight, &logit) in weights.iter_mut().zip(logits) {
            *weight = logit.into();
        }
        exp_minus_max(&mut weights, max.into());
        let (mut weighted, mut total) = (0.0, 0.0);
        for (i, weight) in (0..).zip(&weights) {
            weighted += weight * f64::from(i);
            total += weight;
        }
        *value = (v_min + spacing * (weighted / total)).clamp(v_min, v_max) as f32;
    }
}

/// Returns the first of two or more atoms, and the spacing of the atoms.
fn v_min_and_spacing(support: &[f32]) -> (f64, f64) {
    let (v_min, v_max) = (f64::from(support[0]), f64::from(support[support.len() - 1]));
    (v_min, (v_max - v_min) / (support.len() - 1) as f64)
}

/// `driml experiment stability` compares values with float64.
#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn logits_that_are_not_finite_give_no_number() {
        for bad in [f32::NAN, f32::INFINITY] {
            let mut value = [0.0];
            expected_returns(&[0.0, bad, 1.0], &[-1.0, 0.0, 1.0], &mut value);
            assert!(value[0].is_nan());
        }
        let mut value = [0.0];
        expected_returns(&[f32::NEG_INFINITY; 3], &[-1.0, 0.0, 1.0], &mut value);
        assert!(value[0].is_nan());
        let logits = [0.0, f32::NEG_INFINITY, 0.0];
        expected_returns(&logits, &[-1.0, 0.0, 2.0], &mut value);
        assert_eq!(value, [0.5]);
    }
}
