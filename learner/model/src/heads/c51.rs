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
use crate::kernels::linear::floats;
use crate::parameters::Parameters;

/// Distributions that one task takes.
const TASK_DISTRIBUTIONS: usize = 256;

#[derive(Debug)]
pub(crate) struct C51Head {
    kernels: Kernels,
    weight: Tensor,
    bias: Tensor,
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
            weight: parameters.tensor("head", "weight")?,
            bias: parameters.tensor("head", "bias")?,
            actions: config.num_actions,
            atoms: config.atoms,
            support: config.atoms_support(),
        })
    }

    /// Logits [B, A, atoms] of f4 [B, hidden] before its ReLU.
    pub(crate) fn logits(&self, f4: &Tensor) -> Result<Tensor> {
        let active = self.kernels.relu(f4)?;
        let logits = self.kernels.linear(&active, &self.weight, &self.bias)?;
        Ok(logits.reshape(((), self.actions, self.atoms))?)
    }

    /// Expected returns [B, A] of logits [B, A, atoms]; no gradient flows.
    pub(crate) fn q_values(&self, logits: &Tensor) -> Result<Tensor> {
        match self.kernels {
            Kernels::Fused(_) => Ok(logits.contiguous()?.apply_op1_no_bwd(&Expectation {
                support: self.support.clone(),
            })?),
            Kernels::Candle => {
                let support = Tensor::new(self.support.as_slice(), logits.device())?;
                let probs = softmax(&logits.detach(), D::Minus1)?;
                Ok(probs.broadcast_mul(&support)?.sum(D::Minus1)?)
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

/// Expectation of softmax(logits) over the atoms z: sum_i exp(l_i - max l) z_i / sum_i exp(l_i - max l).
///
/// `logits` [n, atoms], `support` [atoms], `values` [n]. A distribution with a NaN or an infinite maximum gives NaN.
pub(crate) fn expected_returns(logits: &[f32], support: &[f32], values: &mut [f32]) {
    for (value, logits) in values.iter_mut().zip(logits.chunks_exact(support.len())) {
        let max = logits.iter().copied().fold(f32::NEG_INFINITY, f32::max);
        let (mut weighted, mut total) = (0.0, 0.0);
        for (logit, atom) in logits.iter().zip(support) {
            let weight = (logit - max).exp();
            weighted += weight * atom;
            total += weight;
        }
        *value = weighted / total;
    }
}
