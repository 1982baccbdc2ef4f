//! Helpers of several tests: random tensors, comparisons, small networks.
//! This file holds no tests.

use candle_core::{DType, Device, Result, Tensor};
use driml_model::{
    ConvLayer, HeadConfig, ModelConfig, Parameters, PolicyNetwork, Precision, TorsoName,
};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{RngCore, SeedableRng};

pub(crate) fn rng(seed: u64) -> ChaCha8Rng {
    ChaCha8Rng::seed_from_u64(seed)
}

/// Values uniform on [-1, 1).
pub(crate) fn floats(shape: &[usize], rng: &mut ChaCha8Rng) -> Tensor {
    let uniform = |_| (rng.next_u32() >> 8) as f32 / (1 << 23) as f32 - 1.0;
    let values: Vec<f32> = (0..shape.iter().product()).map(uniform).collect();
    Tensor::from_vec(values, shape, &Device::Cpu).unwrap()
}

pub(crate) fn bytes(len: usize, rng: &mut ChaCha8Rng) -> Vec<u8> {
    (0..len).map(|_| rng.next_u32() as u8).collect()
}

pub(crate) fn frames(config: &ModelConfig, batch: usize, rng: &mut ChaCha8Rng) -> Tensor {
    let shape = (batch, config.height, config.width, config.input_channels);
    Tensor::from_vec(bytes(batch * config.frame_len(), rng), shape, &Device::Cpu).unwrap()
}

pub(crate) fn double(tensor: &Tensor) -> Result<Tensor> {
    tensor.to_dtype(DType::F64)
}

pub(crate) fn values(tensor: &Tensor) -> Vec<f64> {
    let flat = double(tensor).unwrap().flatten_all().unwrap();
    flat.to_vec1().unwrap()
}

pub(crate) fn bits(tensor: &Tensor) -> Vec<u32> {
    let values: Vec<f32> = tensor.flatten_all().unwrap().to_vec1().unwrap();
    values.iter().map(|value| value.to_bits()).collect()
}

/// A small network with all heads, whose widths do not fill registers.
pub(crate) fn small() -> ModelConfig {
    ModelConfig {
        height: 36,
        width: 44,
        input_channels: 3,
        num_actions: 5,
        atoms: 11,
        v_min: -2.0,
        v_max: 3.0,
        conv: vec![
            ConvLayer::new(5, 8, 4),
            ConvLayer::new(7, 3, 2),
            ConvLayer::new(6, 2, 1),
        ],
        hidden: 19,
        embedding_dim: 13,
        action_embed: 9,
        ..ModelConfig::small()
    }
}

/// [`small`] with a residual torso: maps of 11 x 14, 6 x 7 and 3 x 4.
pub(crate) fn residual(torso: TorsoName) -> ModelConfig {
    ModelConfig {
        height: 11,
        width: 14,
        torso,
        conv: vec![],
        channels: vec![5, 7],
        scale_blocks: true,
        ..small()
    }
}

pub(crate) fn small_with(head: HeadConfig) -> ModelConfig {
    ModelConfig { head, ..small() }
}

pub(crate) const DUELING: HeadConfig = HeadConfig {
    dueling: true,
    noisy_sigma: None,
};
pub(crate) const NOISY: HeadConfig = HeadConfig {
    dueling: false,
    noisy_sigma: Some(0.5),
};

/// Small networks with every kind of head, and with every torso.
pub(crate) fn configs() -> impl Iterator<Item = ModelConfig> {
    let heads = [HeadConfig::PLAIN, DUELING, NOISY, HeadConfig::RAINBOW].map(small_with);
    let torsos = [TorsoName::Impala, TorsoName::Impoola].map(residual);
    heads.into_iter().chain(torsos)
}

pub(crate) fn parameters(config: &ModelConfig, seed: u64) -> Parameters {
    Parameters::init(config, &mut rng(seed), &Device::Cpu).unwrap()
}

pub(crate) fn pool(threads: usize) -> rayon::ThreadPool {
    let pool = rayon::ThreadPoolBuilder::new().num_threads(threads);
    pool.build().unwrap()
}

pub(crate) fn policy(
    config: &ModelConfig,
    parameters: &Parameters,
    precision: Precision,
) -> PolicyNetwork {
    let weights = parameters.to_safetensors(|_| true).unwrap();
    PolicyNetwork::new(config, &weights, precision).unwrap()
}

/// Returns the values of five actions for each of these frames.
pub(crate) fn q_values(
    policy: &mut PolicyNetwork,
    config: &ModelConfig,
    frames: &[u8],
) -> Vec<f32> {
    let mut values = vec![0.0; frames.len() / config.frame_len() * 5];
    policy.q_values(frames, &mut values).unwrap();
    values
}
