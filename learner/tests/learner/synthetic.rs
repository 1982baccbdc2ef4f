//! Small networks, settings and batches for these tests, and checks that several tests share.
//! Nothing here is measured.

use std::{collections::HashMap, fmt::Display};

use candle_core::{Device, Tensor};
use driml_learner::{
    AdamSettings, Agent, AuxiliaryKind, Lambda, LearnedSettings, OwnedBatch, UpdateSettings,
    auxiliary::{cpc, curl, dim},
    parity::deviation::REFERENCE,
};
use driml_model::{Compute, ConvLayer, ModelConfig, Parameters};
use driml_protocol::NO_ACTION;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

pub(crate) const ACTIONS: usize = 4;
pub(crate) const NONE: AuxiliaryKind = AuxiliaryKind::NONE;
pub(crate) const DIM: AuxiliaryKind = AuxiliaryKind::from_item(&dim::DIM);
pub(crate) const CPC: AuxiliaryKind = AuxiliaryKind::from_item(&cpc::CPC);
pub(crate) const CURL: AuxiliaryKind = AuxiliaryKind::from_item(&curl::CURL);
pub(crate) const NO_DIM: Lambda = Lambda::NONE;
pub(crate) const ALL_DIM: Lambda = Lambda {
    l3t3: 1.0,
    l3t4: 0.5,
    l4t3: 0.25,
    l4t4: 2.0,
};

pub(crate) const LEARNED: LearnedSettings = LearnedSettings {
    hidden: 8,
    lr: 1e-3,
    beta1: 0.9,
    beta2: 0.999,
    eps: 1e-8,
    keep: 0.9,
};

pub(crate) fn model(lambda: Lambda) -> ModelConfig {
    ModelConfig {
        height: 20,
        width: 24,
        input_channels: 2,
        num_actions: ACTIONS,
        atoms: 21,
        v_min: -5.0,
        v_max: 5.0,
        conv: vec![ConvLayer::new(5, 8, 4), ConvLayer::new(6, 3, 1)],
        hidden: 16,
        embedding_dim: 12,
        action_embed: 7,
        dim: lambda.dim_heads(true),
        ..ModelConfig::small()
    }
}

pub(crate) fn settings(lambda: Lambda) -> UpdateSettings {
    UpdateSettings {
        double_dqn: false,
        auxiliary_loss: if lambda == NO_DIM { NONE } else { DIM },
        condition_on_action: lambda != NO_DIM,
        lambda,
        tanh_clip: 20.0,
        max_grad_norm: 10.0,
        adam: AdamSettings {
            lr: 1e-3,
            beta1: 0.9,
            beta2: 0.999,
            eps: 1e-5,
        },
        target_period_updates: 3,
        target_tau: 0.95,
        average_tau: None,
        own: toml::Table::new(),
    }
}

pub(crate) fn new_agent(
    model: ModelConfig,
    settings: UpdateSettings,
    compute: &Compute,
    seed: u64,
) -> Agent {
    let rng = &mut ChaCha8Rng::seed_from_u64(seed);
    Agent::new(model, settings, compute, rng).unwrap()
}

pub(crate) fn agent(lambda: Lambda, seed: u64) -> Agent {
    agent_on(&Compute::CPU, lambda, seed)
}

pub(crate) fn agent_on(compute: &Compute, lambda: Lambda, seed: u64) -> Agent {
    new_agent(model(lambda), settings(lambda), compute, seed)
}

/// The operations of a GPU, on the CPU.
pub(crate) const CANDLE: Compute = REFERENCE;

pub(crate) fn random_batch(rows: usize, seed: u64) -> OwnedBatch {
    random_batch_of(rows, 20 * 24 * 2, seed)
}

/// A random batch with states of `frame_len` bytes.
pub(crate) fn random_batch_of(rows: usize, frame_len: usize, seed: u64) -> OwnedBatch {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut states = || -> Vec<u8> { (0..rows * frame_len).map(|_| rng.random()).collect() };
    let [states_t, states_k, states_n] = [states(), states(), states()];
    let mut draw =
        |below: u8| -> Vec<u8> { (0..rows).map(|_| rng.random_range(0..below)).collect() };
    let action = draw(ACTIONS as u8);
    let mut next_action = draw(ACTIONS as u8);
    next_action[0] = NO_ACTION;
    OwnedBatch {
        states_t,
        states_k,
        states_n,
        action,
        next_action,
        n_step_return: (0..rows).map(|_| rng.random_range(-3.0..3.0)).collect(),
        bootstrap_discount: (0..rows)
            .map(|row| if row == 0 { 0.0 } else { 0.93 })
            .collect(),
        positive_valid: (0..rows).map(|row| u8::from(row != 0)).collect(),
        ..OwnedBatch::default()
    }
}

pub(crate) fn pool(threads: usize) -> rayon::ThreadPool {
    let pool = rayon::ThreadPoolBuilder::new().num_threads(threads);
    pool.build().unwrap()
}

pub(crate) type Values = HashMap<String, Vec<f32>>;

pub(crate) fn values(parameters: &Parameters) -> Values {
    let flat = |t: &Tensor| t.flatten_all().unwrap().to_vec1::<f32>().unwrap();
    let all = parameters.iter();
    all.map(|(name, var)| (name.to_owned(), flat(var)))
        .collect()
}

/// Checks that an error message contains each of these texts.
#[track_caller]
pub(crate) fn check_says(error: impl Display, all: &[&str]) {
    let said = error.to_string();
    for words in all {
        assert!(said.contains(words), "wanted {words:?} in: {said}");
    }
}

/// Changes the agent's online parameters in place, and returns the agent.
pub(crate) fn change_parameters(agent: Agent, change: impl Fn(&str, &mut [f32])) -> Agent {
    for (name, var) in agent.online().iter() {
        let mut values: Vec<f32> = var.flatten_all().unwrap().to_vec1().unwrap();
        change(name, &mut values);
        let values = Tensor::from_vec(values, var.dims(), &Device::Cpu).unwrap();
        var.set(&values).unwrap();
    }
    agent
}
