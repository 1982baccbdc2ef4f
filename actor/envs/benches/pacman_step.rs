//! How fast Ms. PacMan steps and draws on one core, with and without the Ising model in its walls.
//! It measures no stacking and no other world.

#![allow(missing_docs, reason = "criterion's macros make public functions")]

use std::hint::black_box;

use criterion::{BatchSize, Criterion, Throughput, criterion_group, criterion_main};
use driml_envs::{Environment, IsingOverlay, PacmanConfig, PacmanWorld, StepEnd};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

const NUM_ENVS: usize = 64;

fn config(ising: Option<IsingOverlay>) -> PacmanConfig {
    PacmanConfig {
        epsilon: 0.1,
        switch_probability: 0.25,
        lethal: [true; 4],
        lethal_schedule: None,
        boost_steps: 10,
        step_limit: 500,
        reward_pellet: 0.1,
        reward_boost: 0.1,
        reward_ghost: 0.5,
        reward_death: -1.0,
        reward_cleared: 1.0,
        ising,
    }
}

/// Time for one env step with its frame: `NUM_ENVS` environments under uniformly random actions.
fn steps(criterion: &mut Criterion) {
    let overlay = IsingOverlay {
        temperature: 0.4,
        sweeps_per_step: 1,
    };
    for (name, ising) in [("plain", None), ("ising_overlay", Some(overlay))] {
        let mut world = PacmanWorld::new(&config(ising), NUM_ENVS, 1).expect("valid settings");
        let mut frames = vec![0; NUM_ENVS * world.frame_shape().bytes()];
        let (mut rewards, mut ends) = ([0.0; NUM_ENVS], [StepEnd::Running; NUM_ENVS]);
        let mut rng = ChaCha8Rng::seed_from_u64(2);
        let mut group = criterion.benchmark_group("pacman_step");
        group.throughput(Throughput::Elements(NUM_ENVS as u64));
        group.bench_function(name, |bencher| {
            bencher.iter_batched(
                || -> [u8; NUM_ENVS] { std::array::from_fn(|_| rng.random_range(0..5)) },
                |actions| {
                    world.observe(&mut frames);
                    world
                        .step(&actions, &mut rewards, &mut ends)
                        .expect("valid actions");
                    black_box(&frames);
                },
                BatchSize::SmallInput,
            );
        });
        group.finish();
    }
}

criterion_group!(benches, steps);
criterion_main!(benches);
