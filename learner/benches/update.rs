//! One update at the paper's sizes: batch 256, 64x64x3 frames, 15 actions, 51 atoms; of each auxiliary objective, and of
//! the augmentation of its states alone. Batches are made up, so that nothing but the arithmetic is measured.

#![allow(missing_docs, reason = "criterion's macros make public functions")]

use std::{hint::black_box, time::Duration};

use criterion::{Criterion, Throughput, criterion_group, criterion_main};
use driml_learner::{
    AdamSettings, Agent, Augment, AugmentSettings, Batch, Lambda, LearnerSettings, Objective,
    auxiliary::{cpc, curl, dim},
};
use driml_model::{Compute, ConvLayer, DimHeads, HeadConfig, ModelConfig};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

const ROWS: usize = 256;
const ACTIONS: usize = 15;
const STATE_BYTES: usize = 64 * 64 * 3;
/// Positives a row of the agent cpc.
const CPC: usize = 5;

fn agent(objective: Objective, lambda: Lambda) -> Agent {
    let layer = |out, kernel, stride| ConvLayer {
        out,
        kernel,
        stride,
    };
    let settings = LearnerSettings {
        double_dqn: false,
        objective,
        condition_on_action: objective == Objective::of(&dim::DIM),
        lambda,
        tanh_clip: 20.0,
        max_grad_norm: 10.0,
        adam: AdamSettings {
            lr: 2.5e-4,
            beta1: 0.9,
            beta2: 0.999,
            eps: 0.01 / 256.0,
        },
        target_period_updates: 312,
        target_tau: 0.95,
        average_tau: None,
        own: if objective == Objective::of(&curl::CURL) {
            let table = toml::Table::from_iter([("key_tau".to_owned(), 0.001.into())]);
            toml::Table::from_iter([("curl".to_owned(), table.into())])
        } else {
            toml::Table::new()
        },
    };
    let mut model = ModelConfig {
        height: 64,
        width: 64,
        channels: 3,
        num_actions: ACTIONS,
        atoms: 51,
        v_min: -10.0,
        v_max: 10.0,
        conv: vec![layer(32, 8, 4), layer(64, 4, 2), layer(64, 3, 1)],
        hidden: 512,
        rkhs: 512,
        action_embed: 64,
        dim: DimHeads::NONE,
        head: HeadConfig::PLAIN,
    };
    model.dim = settings.dim_heads(ACTIONS);
    Agent::new(
        model,
        settings,
        &Compute::CPU,
        &mut ChaCha8Rng::seed_from_u64(1),
    )
    .expect("settings in range")
}

fn frames(rows: usize, seed: u64) -> Vec<u8> {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    (0..rows * STATE_BYTES).map(|_| rng.random()).collect()
}

fn updates(criterion: &mut Criterion) {
    let (states_t, states_k, states_n) = (frames(ROWS, 2), frames(CPC * ROWS, 3), frames(ROWS, 4));
    let anchors = frames(ROWS, 5);
    let action: Vec<u8> = (0..ROWS).map(|row| (row % ACTIONS) as u8).collect();
    let n_step_return: Vec<f32> = (0..ROWS).map(|row| row as f32 / 64.0 - 2.0).collect();
    // Now and then an episode ends.
    let valid: Vec<u8> = (0..CPC * ROWS).map(|at| u8::from(at % 100 != 0)).collect();

    let mut group = criterion.benchmark_group("update");
    group
        .throughput(Throughput::Elements(1))
        .sample_size(20)
        .measurement_time(Duration::from_secs(10));
    for (name, objective, l3t3, l4t4, positives, augmented) in [
        ("c51", Objective::NONE, 0.0, 0.0, 0, false),
        ("c51+4t4", Objective::of(&dim::DIM), 0.0, 1.0, 1, false),
        ("c51+3t3+4t4", Objective::of(&dim::DIM), 1.0, 1.0, 1, false),
        (
            "c51+4t4, augmented",
            Objective::of(&dim::DIM),
            0.0,
            1.0,
            1,
            true,
        ),
        ("cpc", Objective::of(&cpc::CPC), 0.0, 1.0, CPC, false),
        ("curl", Objective::of(&curl::CURL), 0.0, 1.0, 1, true),
    ] {
        let mut agent = agent(
            objective,
            Lambda {
                l3t3,
                l3t4: 0.0,
                l4t3: 0.0,
                l4t4,
            },
        );
        let batch = Batch {
            rows: ROWS,
            states_t: &states_t,
            anchors: augmented.then_some(anchors.as_slice()),
            positives,
            states_k: &states_k[..positives * ROWS * STATE_BYTES],
            states_n: &states_n,
            action: &action,
            next_action: &action,
            n_step_return: &n_step_return,
            bootstrap_discount: &[0.93; ROWS],
            importance_weight: None,
            positive_valid: match positives {
                CPC => &valid,
                _ => &[1; ROWS][..positives * ROWS],
            },
        };
        group.bench_function(name, |bencher| {
            bencher.iter(|| black_box(agent.update(&batch).expect("a good batch")));
        });
    }
    group.finish();
}

fn augmentation(criterion: &mut Criterion) {
    let states = frames(ROWS, 6);
    let mut seen = Vec::new();
    let mut rng = ChaCha8Rng::seed_from_u64(7);
    let mut group = criterion.benchmark_group("augment");
    group.throughput(Throughput::Elements(ROWS as u64));
    for (name, crop_side, jitter) in [
        ("crop and jitter", 0.8, 0.4),
        ("crop", 0.8, 0.0),
        ("jitter", 1.0, 0.4),
        ("nothing", 1.0, 0.0),
    ] {
        let settings = AugmentSettings {
            crop_side,
            brightness: jitter,
            contrast: jitter,
            saturation: jitter,
            hue: jitter,
        };
        let mut augment = Augment::new(settings, (64, 64, 3), 3);
        group.bench_function(name, |bencher| {
            bencher.iter(|| augment.apply(black_box(&states), &mut seen, &mut rng));
        });
    }
    group.finish();
}

criterion_group!(benches, updates, augmentation);
criterion_main!(benches);
