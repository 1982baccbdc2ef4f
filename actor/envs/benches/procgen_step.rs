//! Steps of the Procgen world per second, with 32 copies: the ceiling of one actor.
//! It measures no policy; actions are drawn beforehand.
#![allow(
    missing_docs,
    clippy::unwrap_used,
    clippy::print_stdout,
    reason = "a bench"
)]

use criterion::{BenchmarkId, Criterion, Throughput, criterion_group, criterion_main};
use driml_envs::{
    DistributionMode, Environment, Game, ProcgenConfig, ProcgenEngine, ProcgenWorld, StepEnd,
};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

const NUM_ENVS: usize = 32;

fn steps(criterion: &mut Criterion) {
    let engine = ProcgenEngine::install(&mut |line| println!("{line}")).unwrap();
    let mut group = criterion.benchmark_group("procgen_step");
    group.throughput(Throughput::Elements(NUM_ENVS as u64));
    group.sample_size(20);
    for game in [Game::Bigfish, Game::Coinrun, Game::Maze, Game::Starpilot] {
        for threads in [0, 2] {
            let config = ProcgenConfig {
                game,
                distribution_mode: DistributionMode::Easy,
                num_levels: 500,
                start_level: 0,
                use_sequential_levels: true,
                paint_vel_info: true,
                use_backgrounds: true,
                center_agent: true,
                restrict_themes: false,
                frame_side: 64,
                grey: false,
                library: None,
            };
            let mut world =
                ProcgenWorld::with_engine(&engine, &config, NUM_ENVS, 1, threads).unwrap();
            let mut rng = ChaCha8Rng::seed_from_u64(1);
            let actions: Vec<Vec<u8>> = (0..1024)
                .map(|_| (0..NUM_ENVS).map(|_| rng.random_range(0..15)).collect())
                .collect();
            let mut actions = actions.iter().cycle();
            let mut frames = vec![0; NUM_ENVS * world.frame_shape().bytes()];
            let (mut rewards, mut ends) = ([0.0; NUM_ENVS], [StepEnd::Running; NUM_ENVS]);
            group.bench_function(
                BenchmarkId::new(game.name(), format!("{threads} threads")),
                |bencher| {
                    bencher.iter(|| {
                        world
                            .step(actions.next().unwrap(), &mut rewards, &mut ends)
                            .unwrap();
                        world.observe(&mut frames);
                    });
                },
            );
        }
    }
    group.finish();
}

criterion_group!(benches, steps);
criterion_main!(benches);
