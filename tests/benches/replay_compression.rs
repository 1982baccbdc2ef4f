//! What the replay's compression saves on real Procgen frames, and what it costs: bytes per transition, time of inserts and batches.
//! The bench measures neither the codec nor the network.
//!
//! The frames come from 16 copies under a random policy, or under one that mostly runs to the right: scrolling frames compress worse.
#![allow(
    missing_docs,
    clippy::unwrap_used,
    clippy::print_stdout,
    reason = "a bench"
)]

use std::{hint::black_box, time::Instant};

use driml_actor::ChunkRecorder;
use driml_envs::{ProcgenEngine, StepEnd};
use driml_machine::resources::Machine;
use driml_protocol::{ActorJoin, Buffer, BufferPool, Chunk, InsertReply};
use driml_replay_server::{Compression, Config, Replay};
use driml_settings::{config::RunConfig, flags::resolve_names};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

const ROWS: u32 = 256;
const COPIES: usize = 16;
const STEPS_PER_CHUNK: usize = 16;
const CHUNKS: usize = 100;
const TRANSITIONS: u64 = (CHUNKS * COPIES * STEPS_PER_CHUNK) as u64;
/// The action "right".
const RIGHT: u8 = 7;

/// The paper's settings of a game, with frames as they are.
fn settings(game: &str) -> RunConfig {
    // The memory that is free now must not change the settings.
    let machine = Machine {
        memory_bytes: u64::MAX,
        ..Machine::detect()
    };
    let world = format!("procgen:{game}");
    let config = resolve_names("paper", &world, "driml-ada", &[], &machine).unwrap();
    config.with_whole_frames().unwrap()
}

fn replay(config: &RunConfig, compression: Compression) -> Replay {
    let replay = Config {
        compression,
        ..Config::unlimited(TRANSITIONS)
    };
    let mut replay = Replay::new(&config.run, &replay, ROWS).unwrap();
    replay.join_actor(ActorJoin::new(0, 1)).unwrap();
    replay
}

/// Returns what 16 copies of a game show, as the chunks of an actor.
fn chunks(config: &RunConfig, runs_right: bool) -> Vec<Chunk> {
    let mut world = config.world.build(COPIES, 1, 0).unwrap();
    let frame_bytes = world.frame_shape().bytes();
    let (pool, streams) = (BufferPool::new(0), COPIES as u32);
    let mut recorder = ChunkRecorder::new(pool, 0, 1, streams, frame_bytes as u32);
    recorder.begin_chunk(1, STEPS_PER_CHUNK as u32);
    let mut rng = ChaCha8Rng::seed_from_u64(1);
    let mut frames = vec![0; COPIES * frame_bytes];
    let (mut rewards, mut ends) = ([0.0; COPIES], [StepEnd::Running; COPIES]);
    let mut step = || {
        let mut action = || match rng.random_range(0..15) {
            _ if runs_right && rng.random_bool(0.7) => RIGHT,
            action => action,
        };
        let actions: [u8; COPIES] = std::array::from_fn(|_| action());
        world.observe(&mut frames);
        world.step(&actions, &mut rewards, &mut ends).unwrap();
        recorder.record(&frames, &actions, &rewards, &ends)
    };
    let steps = 0..CHUNKS * STEPS_PER_CHUNK;
    steps.filter_map(|_| step()).collect()
}

/// Stores the next chunk; the chunks repeat endlessly.
fn insert_next(replay: &mut Replay, chunks: &mut [Chunk], sequence: usize) {
    let chunk = &mut chunks[sequence % CHUNKS];
    chunk.header.sequence = sequence as u64;
    chunk.header.first_transition = sequence as u64 * TRANSITIONS / CHUNKS as u64;
    assert!(matches!(replay.insert(chunk), InsertReply::Stored { .. }));
}

fn mean_us(mut work: impl FnMut(usize)) -> f64 {
    let started = Instant::now();
    (0..CHUNKS).for_each(&mut work);
    started.elapsed().as_secs_f64() * 1e6 / CHUNKS as f64
}

fn main() {
    ProcgenEngine::install(&mut |line| println!("{line}")).unwrap();
    for (game, runs_right) in [
        ("bigfish", false),
        ("coinrun", false),
        ("coinrun", true),
        ("maze", false),
        ("starpilot", false),
    ] {
        let name = format!("{game}{}", if runs_right { ", right" } else { "" });
        let config = settings(game);
        let mut chunks = chunks(&config, runs_right);
        for compression in [Compression::None, Compression::Lz4] {
            let mut replay = replay(&config, compression);
            // The first round fills the replay, the second replaces its transitions.
            mean_us(|sequence| insert_next(&mut replay, &mut chunks, sequence));
            let insert =
                mean_us(|sequence| insert_next(&mut replay, &mut chunks, CHUNKS + sequence));
            let draw = mean_us(|_| drop(black_box(replay.draw(ROWS, Buffer::zeroed).unwrap())));
            let batch = mean_us(|_| drop(black_box(replay.sample(ROWS).unwrap())));
            let held = replay.status().frame_bytes_held as f64 / TRANSITIONS as f64;
            println!(
                "{name}, {compression:?}: {held:.0} bytes of frames a transition, {:.2} GB for 10^6 with all fields; \
                 insert of 16 x 16 {insert:.0} us, draw of 256 {draw:.0} us, batch of 256 {batch:.0} us",
                (held + 32.0) / 1e3
            );
        }
    }
}
