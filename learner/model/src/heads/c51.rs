//! The C51 head: relu(f4) to a distribution over the atoms for each action, and its expectation.
//! It computes no loss and no projection.
//!
//! Source: Bellemare et al. 2017.

use candle_core::{CpuStorage, CustomOp1, D, Layout, Shape, Tensor};
use candle_nn::ops::softmax;
use rayon::prelude::*;

use crate::compute::Kernels;
use crate::config::ModelConfig;
use crate::error::Result;
use crate::heads::noise::HeadNoise;
use crate::heads::streams::{LinearLayer, Streams};
use crate::kernels::exponentials::exp_below;
use crate::kernels::tensors::floats;
use crate::parameters::Parameters;

/// Distributions that one task takes.
const TASK_DISTRIBUTIONS: usize = 256;

#[derive(Debug)]
pub(crate) struct C51Head {
    kernels: Kernels,
    streams: Streams,
    actions: usize,
    atoms: usize,
    support: Vec<f32>,
}

impl C51Head {
    pub(crate) fn new(
        config: &ModelConfig,
        parameters: &Parameters,
        kernels: Kernels,
    ) -> Result<Self> {
        Ok(Self {
            kernels,
            streams: Streams::new(config, parameters)?,
            actions: config.num_actions,
            atoms: config.atoms,
            support: config.atoms_support(),
        })
    }

    /// Logits [B, A, atoms] of f4 [B, hidden] before its ReLU; a noisy layer without noise is its mean.
    pub(crate) fn logits(&self, f4: &Tensor, noise: Option<&HeadNoise>) -> Result<Tensor> {
        let active = self.kernels.relu(f4)?;
        let layer = self.streams.layer(noise)?;
        let logits = self.kernels.linear(&active, &layer.weight, &layer.bias)?;
        Ok(logits.reshape(((), self.actions, self.atoms))?)
    }

    /// Of those logits the ones [B, atoms] of one action a row.
    pub(crate) fn taken_logits(
        &self,
        f4: &Tensor,
        actions: &[u8],
        noise: Option<&HeadNoise>,
    ) -> Result<Tensor> {
        let active = self.kernels.relu(f4)?;
        let LinearLayer { weight, bias } = self.streams.layer(noise)?;
        Ok(self
            .kernels
            .grouped_linear(&active, &weight, &bias, actions, self.atoms)?)
    }

    /// Expected returns [B, A] of logits [B, A, atoms]; no gradient flows.
    pub(crate) fn q_values(&self, logits: &Tensor) -> Result<Tensor> {
        match self.kernels {
            Kernels::Fused(_) => Ok(logits.contiguous()?.apply_op1_no_bwd(&Expectation {
                support: self.support.clone(),
            })?),
            Kernels::Candle => {
                let (v_min, spacing) = ends(&self.support);
                let positions = Tensor::arange(0f32, self.atoms as f32, logits.device())?;
                let probs = softmax(&logits.detach(), D::Minus1)?;
                let mean = probs.broadcast_mul(&positions)?.sum(D::Minus1)?;
                Ok(mean.affine(spacing, v_min)?)
            }
        }
    }
}

struct Expectation {
    support: Vec<f32>,
}

impl CustomOp1 for Expectation {
    fn name(&self) -> &'static str {
        "c51-expectation"
    }

    fn cpu_fwd(
        &self,
        logits: &CpuStorage,
        layout: &Layout,
    ) -> candle_core::Result<(CpuStorage, Shape)> {
        let (batch, actions, atoms) = layout.shape().dims3()?;
        if atoms != self.support.len() {
            candle_core::bail!(
                "logits {:?} over {} atoms",
                layout.shape(),
                self.support.len()
            );
        }
        let mut values = vec![0.0; batch * actions];
        values
            .par_chunks_mut(TASK_DISTRIBUTIONS)
            .zip(floats(logits, layout)?.par_chunks(TASK_DISTRIBUTIONS * atoms))
            .for_each(|(values, logits)| expected_returns(logits, &self.support, values));
        Ok((CpuStorage::F32(values), (batch, actions).into()))
    }
}

/// Largest error of an expected return beside its own last place, as a share of the support's width: what sums over a thousand
/// atoms lose in f64.
pub const EXPECTED_RETURN_ERROR: f64 = 8e-15;

/// Expectation of softmax(logits) over atoms i of equal spacing: z_0 + spacing * sum_i w_i i / sum_i w_i with w_i = exp(l_i - max l).
///
/// `logits` [n, atoms]; `support` [atoms], of which the ends and the length count; `values` [n]. The sum is over positions, not
/// over returns: an error is at most [`EXPECTED_RETURN_ERROR`] of the support's width beside the value's own last place, wherever the
/// support lies, no value is beyond its ends, and no support that f32 holds overflows. A distribution with a NaN or an infinite maximum gives NaN.
pub(crate) fn expected_returns(logits: &[f32], support: &[f32], values: &mut [f32]) {
    let (v_min, spacing) = ends(support);
    let v_max = f64::from(support[support.len() - 1]);
    let mut weights = vec![0.0; support.len()];
    for (value, logits) in values.iter_mut().zip(logits.chunks_exact(support.len())) {
        let max = logits.iter().copied().fold(f32::NEG_INFINITY, f32::max);
        for (weight, &logit) in weights.iter_mut().zip(logits) {
            *weight = logit.into();
        }
        exp_below(&mut weights, max.into());
        let (mut weighted, mut total) = (0.0, 0.0);
        for (i, weight) in (0..).zip(&weights) {
            weighted += weight * f64::from(i);
            total += weight;
        }
        *value = (v_min + spacing * (weighted / total)).clamp(v_min, v_max) as f32;
    }
}

/// The first of two or more atoms, and the distance from each to the next.
fn ends(support: &[f32]) -> (f64, f64) {
    let (v_min, v_max) = (f64::from(support[0]), f64::from(support[support.len() - 1]));
    (v_min, (v_max - v_min) / (support.len() - 1) as f64)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    /// The same in float64, over the support that the ends stand for.
    fn exactly(logits: &[f32], v_min: f64, v_max: f64) -> f64 {
        let max = f64::from(logits.iter().copied().fold(f32::MIN, f32::max));
        let weights = logits.iter().map(|&logit| (f64::from(logit) - max).exp());
        let (mut sum, mut weighted) = (0.0, 0.0);
        for (i, weight) in weights.enumerate() {
            sum += weight;
            weighted += weight * i as f64;
        }
        v_min + (v_max - v_min) / (logits.len() - 1) as f64 * (weighted / sum)
    }

    /// Logits of one distribution: flat, spread, nearly one-hot; `draw` in [0, 1).
    fn logits(atoms: usize, scale: f32, draw: &mut impl FnMut() -> f32) -> Vec<f32> {
        (0..atoms).map(|_| (draw() - 0.5) * scale).collect()
    }

    #[test]
    fn values_are_right_wherever_the_support_lies() {
        let mut state = 7u64;
        let mut draw = || {
            state = state
                .wrapping_mul(6_364_136_223_846_793_005)
                .wrapping_add(1_442_695_040_888_963_407);
            (state >> 40) as f32 / (1 << 24) as f32
        };
        for (v_min, v_max) in [
            (-10.0f32, 10.0f32),
            (0.0, 1.0),
            (1000.0, 1001.0),
            (1e6, 1e6 + 1.0),
            (-1e6 - 1.0, -1e6),
            (-1e-7, 1e-7),
            (-1e30, 1e30),
            (0.0, 1e30),
            // v_min + width is not v_max in f64 either.
            (-9.174_887e29, -7.596_588_6),
            (-3e38, 3e38),
        ] {
            let (low, high) = (f64::from(v_min), f64::from(v_max));
            for atoms in [2, 51, 1001] {
                let mut support = vec![0.0; atoms];
                (support[0], support[atoms - 1]) = (v_min, v_max);
                for scale in [0.0, 1.0, 30.0, 1e4, 1e38] {
                    for _ in 0..50 {
                        let logits = logits(atoms, scale, &mut draw);
                        let mut value = [f32::NAN];
                        expected_returns(&logits, &support, &mut value);
                        let expected = exactly(&logits, low, high);
                        // Half of the last place of the value itself, which an f32 cannot be without.
                        let allowed =
                            EXPECTED_RETURN_ERROR * (high - low) + expected.abs() / 2f64.powi(24);
                        let error = (f64::from(value[0]) - expected).abs();
                        assert!(
                            error <= allowed,
                            "{atoms} atoms on [{v_min}, {v_max}], logits of {scale}: {} and {expected}",
                            value[0]
                        );
                        assert!(
                            (v_min..=v_max).contains(&value[0]),
                            "{value:?} on [{v_min}, {v_max}]"
                        );
                    }
                }
            }
        }
    }

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
        expected_returns(
            &[0.0, f32::NEG_INFINITY, 0.0],
            &[-1.0, 0.0, 2.0],
            &mut value,
        );
        assert_eq!(value, [0.5]);
    }

    proptest! {
        /// Logits and ends of supports over all of an f32's range, subnormal and equal ones among them.
        #[test]
        fn values_of_any_logits_are_those_of_float64(
            mut logits in prop::collection::vec(
                prop_oneof![
                    3 => -20.0f32..20.0,
                    2 => prop::num::f32::NORMAL | prop::num::f32::SUBNORMAL | prop::num::f32::ZERO,
                    1 => prop::sample::select(vec![0.0, f32::MAX, f32::MIN, f32::NEG_INFINITY]),
                ],
                2..120,
            ),
            equal in any::<bool>(),
            ends in [-1e30f32..1e30, -10.0f32..10.0].prop_flat_map(|[far, near]| {
                let ends = (prop_oneof![Just(far), Just(near), Just(0.0)], prop_oneof![Just(far), Just(near), Just(1.0)]);
                ends.prop_filter("two ends", |(a, b)| a != b)
            }),
        ) {
            if equal || logits.iter().all(|logit| logit.is_infinite()) {
                let first = logits[0].max(f32::MIN);
                logits.fill(first);
            }
            let (v_min, v_max) = (ends.0.min(ends.1), ends.0.max(ends.1));
            let mut support = vec![0.0; logits.len()];
            (support[0], support[logits.len() - 1]) = (v_min, v_max);
            let mut value = [f32::NAN];
            expected_returns(&logits, &support, &mut value);
            let (low, high) = (f64::from(v_min), f64::from(v_max));
            let expected = exactly(&logits, low, high);
            let allowed = EXPECTED_RETURN_ERROR * (high - low) + expected.abs() / 2f64.powi(24);
            prop_assert!((f64::from(value[0]) - expected).abs() <= allowed, "{value:?}, {expected}");
            prop_assert!((v_min..=v_max).contains(&value[0]), "{value:?}");
        }
    }
}
