//! One update at the paper's sizes: batch 256, 64x64x3 frames, 15 actions, 51 atoms; C51 alone and with DIM.
//! Batches are made up, so that nothing but the arithmetic is measured.

#![allow(missing_docs, reason = "criterion's macros make public functions")]

use std::{hint::black_box, time::Duration};

use criterion::{Criterion, Throughput, criterion_group, criterion_main};
use driml_learner::{AdamSettings, Batch, Lambda, Learner, LearnerSettings};
use driml_model::{ConvLayer, ModelConfig};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

const ROWS: usize = 256;
const ACTIONS: usize = 15;

fn learner(lambda: Lambda) -> Learner {
    let layer = |out, kernel, stride| ConvLayer {
        out,
        kernel,
        stride,
    };
    let model = ModelConfig {
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
        dim: lambda.dim_parts(true),
    };
    let settings = LearnerSettings {
        double_dqn: false,
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
    };
    Learner::new(model, settings, &mut ChaCha8Rng::seed_from_u64(1)).expect("settings in range")
}

fn updates(criterion: &mut Criterion) {
    let mut rng = ChaCha8Rng::seed_from_u64(2);
    let mut frames = || {
        (0..ROWS * 64 * 64 * 3)
            .map(|_| rng.random())
            .collect::<Vec<u8>>()
    };
    let (frames_t, frames_k, frames_n) = (frames(), frames(), frames());
    let action: Vec<u8> = (0..ROWS).map(|row| (row % ACTIONS) as u8).collect();
    let n_step_return: Vec<f32> = (0..ROWS).map(|row| row as f32 / 64.0 - 2.0).collect();

    let mut group = criterion.benchmark_group("update");
    group
        .throughput(Throughput::Elements(1))
        .sample_size(20)
        .measurement_time(Duration::from_secs(10));
    for (name, l3t3, l4t4) in [
        ("c51", 0.0, 0.0),
        ("c51+4t4", 0.0, 1.0),
        ("c51+3t3+4t4", 1.0, 1.0),
    ] {
        let mut learner = learner(Lambda {
            l3t3,
            l3t4: 0.0,
            l4t3: 0.0,
            l4t4,
        });
        let batch = Batch {
            rows: ROWS,
            frames_t: &frames_t,
            frames_k: (l4t4 > 0.0).then_some(frames_k.as_slice()),
            frames_n: &frames_n,
            action: &action,
            next_action: &action,
            n_step_return: &n_step_return,
            bootstrap_discount: &[0.93; ROWS],
            positive_valid: &[1; ROWS],
        };
        group.bench_function(name, |bencher| {
            bencher.iter(|| black_box(learner.update(&batch).expect("a good batch")));
        });
    }
    group.finish();
}

criterion_group!(benches, updates);
criterion_main!(benches);
