//! The whole DQN network: forward and backward on the learner's batch of 256, and the actor's policy on 32 and 256 frames.
//! The loss is a stand-in (the sum of squared logits and features); the learner's benches have the real one.
#![allow(clippy::unwrap_used, missing_docs)]

use candle_core::{Device, Tensor};
use criterion::{Criterion, criterion_group, criterion_main};
use driml_model::{
    ConvLayer, DimHeads, HeadConfig, ModelConfig, Network, Parameters, PolicyNetwork, Precision,
};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;

const SIZES: [(usize, usize); 2] = [(64, 64), (104, 80)];

fn config((height, width): (usize, usize), dim: DimHeads) -> ModelConfig {
    let layer = |out, kernel, stride| ConvLayer {
        out,
        kernel,
        stride,
    };
    ModelConfig {
        height,
        width,
        channels: 3,
        num_actions: 15,
        atoms: 51,
        v_min: -10.0,
        v_max: 10.0,
        conv: vec![layer(32, 8, 4), layer(64, 4, 2), layer(64, 3, 1)],
        hidden: 512,
        rkhs: 512,
        action_embed: 64,
        dim,
        head: HeadConfig::PLAIN,
    }
}

fn parameters(config: &ModelConfig) -> Parameters {
    Parameters::init(config, &mut ChaCha8Rng::seed_from_u64(1), &Device::Cpu).unwrap()
}

fn frames(config: &ModelConfig, batch: usize) -> Vec<u8> {
    (0..batch * config.frame_len())
        .map(|index| (index * 31 % 256) as u8)
        .collect()
}

fn learner(criterion: &mut Criterion) {
    const BATCH: usize = 256;
    for size in SIZES {
        let mut group =
            criterion.benchmark_group(format!("network {}x{}x3 batch {BATCH}", size.0, size.1));
        group.sample_size(20);
        let heads = DimHeads {
            psi3: true,
            phi3: true,
            psi4: true,
            phi4: true,
            action: true,
        };
        let config = config(size, heads);
        let parameters = parameters(&config);
        let network = Network::new(&config, &parameters).unwrap();
        let shape = (BATCH, size.0, size.1, 3);
        let frames = Tensor::from_vec(frames(&config, BATCH), shape, &Device::Cpu).unwrap();
        let actions = Tensor::from_vec(
            (0..BATCH as u32).map(|row| row % 15).collect(),
            BATCH,
            &Device::Cpu,
        )
        .unwrap();

        group.bench_function("forward", |bencher| {
            bencher.iter(|| {
                network
                    .logits(&network.features(&frames).unwrap().f4)
                    .unwrap()
            });
        });
        group.bench_function("forward and backward", |bencher| {
            bencher.iter(|| {
                let logits = network
                    .logits(&network.features(&frames).unwrap().f4)
                    .unwrap();
                logits.sqr().unwrap().sum_all().unwrap().backward().unwrap()
            });
        });
        group.bench_function("psi4 forward and backward", |bencher| {
            let f4 = network.features(&frames).unwrap().f4.detach();
            bencher.iter(|| {
                network
                    .psi4(&f4, &actions)
                    .unwrap()
                    .sum_all()
                    .unwrap()
                    .backward()
                    .unwrap()
            });
        });
        group.bench_function("psi3 forward and backward", |bencher| {
            let f3 = network.features(&frames).unwrap().local().unwrap().detach();
            bencher.iter(|| {
                network
                    .psi3(&f3, &actions)
                    .unwrap()
                    .sum_all()
                    .unwrap()
                    .backward()
                    .unwrap()
            });
        });
        group.finish();
    }
}

fn actor(criterion: &mut Criterion) {
    for size in SIZES {
        let mut group = criterion.benchmark_group(format!("policy {}x{}x3", size.0, size.1));
        group.sample_size(50);
        let config = config(size, DimHeads::NONE);
        let mut policy = PolicyNetwork::new(
            &config,
            &parameters(&config).to_safetensors(|_| true).unwrap(),
            Precision::F32,
        )
        .unwrap();
        for batch in [1, 32, 256] {
            let frames = frames(&config, batch);
            let mut actions = vec![0; batch];
            group.bench_function(format!("{batch} frames"), |bencher| {
                bencher.iter(|| policy.greedy_actions(&frames, &mut actions).unwrap());
            });
        }
        group.finish();
    }
}

criterion_group!(benches, learner, actor);
criterion_main!(benches);
