//! What the replay's compression saves on real Procgen frames, and what it costs: bytes a transition, inserts, batches.
//! It measures neither the codec nor the network.
//!
//! The frames are those of 16 copies under a random policy, or under one that mostly runs to the right: what scrolls
//! compresses worse.
#![allow(
    missing_docs,
    clippy::unwrap_used,
    clippy::print_stdout,
    reason = "a bench"
)]

use std::{
    hint::black_box,
    sync::Mutex,
    time::{Duration, Instant},
};

use criterion::{BenchmarkId, Criterion, Throughput, criterion_group, criterion_main};
use driml_envs::{
    DistributionMode, Environment, Game, ProcgenConfig, ProcgenEngine, ProcgenWorld, StepEnd,
};
use driml_protocol::{
    ActorJoin, Buffer, Chunk, ChunkHeader, End, Horizon, InsertReply, RunSpec, TimeoutRule,
};
use driml_replay_server::{Compression, Config, Replay};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

const ROWS: u32 = 256;
const COPIES: usize = 16;
const STEPS_PER_CHUNK: usize = 16;
const CHUNKS: usize = 100;
const TRANSITIONS: u64 = (CHUNKS * COPIES * STEPS_PER_CHUNK) as u64;
/// The action "right".
const RIGHT: u8 = 7;

fn replay(compression: Compression, frame_stack: u32) -> Replay {
    let spec = RunSpec {
        world: "bench".into(),
        agent: "bench".into(),
        seed: 1,
        frame_height: 64,
        frame_width: 64,
        frame_channels: 3,
        frame_stack,
        num_actions: 15,
        n_step: 7,
        gamma: 0.99,
        horizon: Horizon::Nhg { k_max: 5 },
        timeout: TimeoutRule::Terminal,
    };
    let config = Config {
        compression,
        ..Config::unlimited(TRANSITIONS)
    };
    let mut replay = Replay::new(&spec, &config, ROWS).unwrap();
    replay
        .join_actor(ActorJoin {
            actor: 0,
            incarnation: 1,
        })
        .unwrap();
    replay
}

/// Everything that 16 copies of a game show, as an actor would send it.
fn chunks(engine: &ProcgenEngine, game: Game, runs_right: bool) -> Vec<Chunk> {
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
    let mut world = ProcgenWorld::with_engine(engine, &config, COPIES, 1, 0).unwrap();
    let frame_bytes = world.frame_shape().bytes();
    let mut rng = ChaCha8Rng::seed_from_u64(1);
    let mut frames = vec![0; COPIES * frame_bytes];
    let (mut rewards, mut ends) = ([0.0; COPIES], [StepEnd::Running; COPIES]);
    let mut chunk = |sequence: usize| {
        let mut chunk = Chunk::zeroed(ChunkHeader {
            actor: 0,
            incarnation: 1,
            sequence: sequence as u64,
            first_transition: (sequence * COPIES * STEPS_PER_CHUNK) as u64,
            weights_version: 1,
            leaving: false,
            streams: COPIES as u32,
            steps: STEPS_PER_CHUNK as u32,
            frame_bytes: frame_bytes as u32,
        });
        for step in 0..STEPS_PER_CHUNK {
            let mut action = || match rng.random_range(0..15) {
                _ if runs_right && rng.random_bool(0.7) => RIGHT,
                action => action,
            };
            let actions: [u8; COPIES] = std::array::from_fn(|_| action());
            world.observe(&mut frames);
            world.step(&actions, &mut rewards, &mut ends).unwrap();
            for (copy, frame) in frames.chunks(frame_bytes).enumerate() {
                let row = copy * STEPS_PER_CHUNK + step;
                chunk.frame_mut(row).copy_from_slice(frame);
                let end = match ends[copy] {
                    StepEnd::Running => End::Running,
                    StepEnd::LevelChange => End::LevelChange,
                    StepEnd::TimedOut => End::TimedOut,
                    StepEnd::Terminal => End::Terminal,
                };
                chunk.set(row, actions[copy], rewards[copy], end);
            }
        }
        chunk
    };
    (0..CHUNKS).map(&mut chunk).collect()
}

/// Stores the next chunk of an endless repetition.
fn insert_next(replay: &mut Replay, chunks: &mut [Chunk], sequence: &mut usize) {
    let chunk = &mut chunks[*sequence % CHUNKS];
    chunk.header.sequence = *sequence as u64;
    chunk.header.first_transition = *sequence as u64 * TRANSITIONS / CHUNKS as u64;
    assert!(matches!(replay.insert(chunk), InsertReply::Stored { .. }));
    *sequence += 1;
}

/// Makes `batches` as the replay server's two threads do: drawn with the replay locked, unpacked without.
fn on_two_threads(replay: &Mutex<Replay>, batches: u64) -> Duration {
    let make = |count| {
        for _ in 0..count {
            let draft = replay.lock().unwrap().draw(ROWS, Buffer::zeroed).unwrap();
            black_box(draft.unpack());
        }
    };
    let started = Instant::now();
    std::thread::scope(|scope| {
        scope.spawn(|| make(batches / 2));
        make(batches.div_ceil(2));
    });
    started.elapsed()
}

fn bench(criterion: &mut Criterion) {
    let engine = ProcgenEngine::install(&mut |line| println!("{line}")).unwrap();
    for (game, runs_right) in [
        (Game::Bigfish, false),
        (Game::Coinrun, false),
        (Game::Coinrun, true),
        (Game::Maze, false),
        (Game::Starpilot, false),
    ] {
        let name = format!("{}{}", game.name(), if runs_right { ", right" } else { "" });
        let mut chunks = chunks(&engine, game, runs_right);
        for compression in [Compression::None, Compression::Lz4] {
            let (mut replay, mut sequence) = (replay(compression, 1), 0);
            for _ in 0..CHUNKS {
                insert_next(&mut replay, &mut chunks, &mut sequence);
            }
            let held = replay.status().frame_bytes_held as f64 / TRANSITIONS as f64;
            println!(
                "{name}, {compression:?}: {held:.0} bytes of frames a transition, {:.2} GB for 10^6 with all fields",
                (held + 32.0) / 1e3
            );
            let how = format!("{compression:?}").to_lowercase();
            let mut group = criterion.benchmark_group(format!("replay of {name}"));
            group.sample_size(10);
            group.warm_up_time(Duration::from_millis(300));
            group.measurement_time(Duration::from_secs(1));
            group.throughput(Throughput::Elements((COPIES * STEPS_PER_CHUNK) as u64));
            group.bench_function(BenchmarkId::new("insert 16 x 16", &how), |b| {
                b.iter(|| insert_next(&mut replay, &mut chunks, &mut sequence));
            });
            group.throughput(Throughput::Elements(1));
            group.bench_function(BenchmarkId::new("draw 256 (locked)", &how), |b| {
                b.iter(|| black_box(replay.draw(ROWS, Buffer::zeroed).unwrap()));
            });
            group.bench_function(BenchmarkId::new("draw and unpack 256", &how), |b| {
                b.iter(|| black_box(replay.sample(ROWS).unwrap()));
            });
            let shared = Mutex::new(replay);
            group.bench_function(BenchmarkId::new("the same on two threads", &how), |b| {
                b.iter_custom(|batches| on_two_threads(&shared, batches));
            });
            group.finish();
        }
    }
}

criterion_group!(benches, bench);
criterion_main!(benches);
