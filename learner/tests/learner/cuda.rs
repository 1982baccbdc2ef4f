//! Compares updates on an NVIDIA GPU with updates on the CPU. Built only with the feature `cuda`; run with
//! `cargo test --release --features driml-learner/cuda -p driml-learner --test learner -- --ignored cuda`.

use driml_learner::{Compute, DeviceName, Precision};
use driml_model::{ModelConfig, TorsoName};

use crate::synthetic::{ALL_DIM, model, new_agent, random_batch_of, settings};

/// Work that several threads queue on a GPU must run in the order in which it was queued. When each thread had its own stream, most
/// updates after the first used states that had not arrived yet. Only large batches show this.
#[test]
#[ignore = "needs an NVIDIA GPU"]
fn updates_on_a_gpu_follow_those_on_the_cpu() {
    let gpu = DeviceName::Cuda(0).open(Precision::F32).unwrap();
    let (height, width, input_channels) = (64, 64, 3);
    let rows = random_batch_of(256, height * width * input_channels, 3);
    let totals = |compute: &Compute| {
        let model = ModelConfig {
            height,
            width,
            input_channels,
            torso: TorsoName::Impala,
            conv: vec![],
            channels: vec![16, 32, 32],
            ..model(ALL_DIM)
        };
        let mut agent = new_agent(model, settings(ALL_DIM), compute, 1);
        (0..10)
            .map(|_| agent.update(&rows.batch()).unwrap().losses.total)
            .collect::<Vec<_>>()
    };
    let (cpu, gpu) = (totals(&Compute::CPU), totals(&gpu));
    for (update, (cpu, gpu)) in cpu.iter().zip(&gpu).enumerate() {
        assert!(
            (cpu - gpu).abs() <= 0.01 * cpu.abs(),
            "update {update}: {cpu} on the CPU, {gpu} on the GPU"
        );
    }
}
