//! The learner's network and optimiser with the auxiliary loss DIM alone, which both studies train.
//! Returns, actions and a replay are not used.

use anyhow::Context;
use candle_core::{DType, Device, Tensor};
use driml_learner::{
    AdamSettings,
    auxiliary::dim::{Dim, HeadVectors},
    losses::scores::ScoreClip,
    optimiser::{
        adam::Adam,
        gradients::{Gradients, clip_factor},
    },
};
use driml_model::{Features, Kernels, ModelConfig, Network, Parameters};
use rand_chacha::ChaCha8Rng;

/// The weights of a network that DIM trains, with the loss and the optimiser.
pub(super) struct DimLearner {
    parameters: Parameters,
    pub(super) network: Network,
    adam: Adam,
    dim: Dim,
    max_grad_norm: f64,
}

impl DimLearner {
    pub(super) fn new(
        model: &ModelConfig,
        dim: Dim,
        adam: AdamSettings,
        max_grad_norm: f64,
        rng: &mut ChaCha8Rng,
    ) -> anyhow::Result<Self> {
        let parameters = Parameters::init(model, rng, &Device::Cpu)?;
        Ok(Self {
            network: Network::new(model, &parameters, Kernels::FUSED)?,
            adam: Adam::new(adam, &parameters, Kernels::FUSED)?,
            parameters,
            dim,
            max_grad_norm,
        })
    }

    /// Makes one update with the InfoNCE loss of the only pair (of 3t3, 3t4, 4t3, 4t4) with a weight. Returns the loss before the update.
    pub(super) fn update(&mut self, now: &Features, next: &Features) -> anyhow::Result<f32> {
        let rows = now.f4.dim(0)?;
        let action = Tensor::zeros(rows, DType::U8, &Device::Cpu)?;
        let (network, valid) = (&self.network, vec![1; rows]);
        let losses = self.dim.pair_losses(network, now, next, &action, &valid)?;
        let loss = losses.into_iter().next();
        let loss = loss.context("no pair of DIM has a weight")?.loss;
        let gradients = Gradients::compute(&self.parameters, &loss)?;
        let factor = clip_factor(gradients.norm(Kernels::FUSED)?, self.max_grad_norm);
        self.adam.step(&self.parameters, &gradients, factor)?;
        Ok(loss.to_scalar()?)
    }

    /// Returns the clipped scores [L, B, B] of every anchor with every candidate at each location, for the only pair with a weight.
    pub(super) fn scores(&self, now: &Features, next: &Features) -> anyhow::Result<Vec<f64>> {
        let action = Tensor::zeros(now.f4.dim(0)?, DType::U8, &Device::Cpu)?;
        let active = self.dim.lambda.active_pairs();
        let vectors = HeadVectors::new(&self.network, now, next, &action, active)?;
        let found = vectors.dot_products(active)?.into_iter().flatten().next();
        let found = found.expect("a pair has a weight");
        let clip = ScoreClip::new(found.width, self.dim.tanh_clip);
        let values = found.values.flatten_all()?.to_vec1::<f32>()?;
        Ok(values.iter().map(|&dot| clip.score(dot)).collect())
    }
}
