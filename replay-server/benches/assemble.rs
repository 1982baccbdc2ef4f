//! How fast chunks are stored and batches put together, against a plain copy of as many bytes.
//! It measures neither the codec nor the network.
#![allow(missing_docs, clippy::unwrap_used)]

use std::hint::black_box;

use criterion::{Criterion, Throughput, criterion_group, criterion_main};
use driml_protocol::{
    ActorJoin, Chunk, ChunkHeader, End, Horizon, InsertReply, RunSpec, TimeoutRule,
};
use driml_replay_server::{Config, Replay};
use rand::{Rng, RngCore, SeedableRng};
use rand_chacha::ChaCha8Rng;

const ROWS: u32 = 256;
const CAPACITY: u64 = 50_000;
const STREAMS: u32 = 16;
const STEPS: u32 = 32;

fn spec(frame_stack: u32) -> RunSpec {
    RunSpec {
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
    }
}

/// A chunk of random frames, actions and rewards, whose episodes last 200 steps on average.
fn chunk() -> Chunk {
    let mut rng = ChaCha8Rng::seed_from_u64(0);
    let mut chunk = Chunk::zeroed(ChunkHeader {
        incarnation: 1,
        streams: STREAMS,
        steps: STEPS,
        frame_bytes: 64 * 64 * 3,
        ..ChunkHeader::default()
    });
    for row in 0..(STREAMS * STEPS) as usize {
        rng.fill_bytes(chunk.frame_mut(row));
        let end = [End::Running, End::Terminal][usize::from(rng.random_bool(1.0 / 200.0))];
        chunk.set(row, rng.random_range(0..15), rng.random(), end);
    }
    chunk
}

fn filled(frame_stack: u32) -> (Replay, Chunk) {
    let config: Config = toml::from_str(&format!(
        "capacity_transitions = {CAPACITY}
         shards = 1
         replay_ratio = 1e9
         warmup_transitions = 0
         slack_transitions = 1125899906842624"
    ))
    .unwrap();
    let mut replay = Replay::new(&spec(frame_stack), &config, ROWS).unwrap();
    let (actor, incarnation) = (0, 1);
    replay.join_actor(ActorJoin { actor, incarnation }).unwrap();
    let mut chunk = chunk();
    while replay.inserted_total() < CAPACITY + 1000 {
        insert_next(&mut replay, &mut chunk);
    }
    (replay, chunk)
}

fn insert_next(replay: &mut Replay, chunk: &mut Chunk) {
    assert!(matches!(replay.insert(chunk), InsertReply::Stored { .. }));
    chunk.header.sequence += 1;
    chunk.header.first_transition += u64::from(STREAMS * STEPS);
}

fn bench(c: &mut Criterion) {
    let (mut replay, mut chunk) = filled(1);
    let mut group = c.benchmark_group("insert");
    group.throughput(Throughput::Elements(u64::from(STREAMS * STEPS)));
    group.bench_function("chunk of 16 x 32", |b| {
        b.iter(|| insert_next(&mut replay, &mut chunk))
    });
    group.finish();
    drop(replay);

    let mut group = c.benchmark_group("batch of 256, 3 states of 64x64x3");
    group.throughput(Throughput::Elements(u64::from(ROWS)));
    let row = 64 * 64 * 3;
    let frames: Vec<u8> = (0..CAPACITY as usize * row).map(|i| i as u8).collect();
    let mut rng = ChaCha8Rng::seed_from_u64(2);
    for stack in [1, 4] {
        // `stack` neighbouring frames from a random place, again and again.
        group.bench_function(format!("plain copy, stack of {stack}"), |b| {
            b.iter(|| {
                let mut out = vec![0; 3 * ROWS as usize * stack * row];
                for out in out.chunks_exact_mut(stack * row) {
                    let at = rng.random_range(0..CAPACITY as usize - stack) * row;
                    out.copy_from_slice(&frames[at..at + stack * row]);
                }
                black_box(out)
            });
        });
        let (mut replay, _) = filled(stack as u32);
        group.bench_function(format!("sample, stack of {stack}"), |b| {
            b.iter(|| black_box(replay.sample(ROWS).unwrap()));
        });
    }
    group.finish();
}

criterion_group!(benches, bench);
criterion_main!(benches);
