//! Batches drawn and put together inside the replay server, without wire and codec.
//! It starts no process.

use std::hint::black_box;

use anyhow::{anyhow, ensure};
use driml_machine::effort::Work;
use driml_protocol::{ActorJoin, Batch, BufferPool, InsertReply, Sampling};
use driml_replay_server::Replay;
use driml_settings::config::RunConfig;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::{
    recording::{CHUNKS, INCARNATION, Recording},
    report::Bench,
    settings::{self, AGENT, CAPACITY},
};

/// The names of [`assembling`]'s figures.
pub(super) const ASSEMBLED: &str = "batch of 3 states, without a wire";
pub(super) const COPIED: &str = "plain copy of a batch's bytes";

/// Side of black frames: so small that the draw is measured and not the copying of states.
const SIDE: u32 = 8;
/// Rainbow's alpha; beta is the learner's.
const PRIORITISED: Sampling = Sampling::Prioritised {
    alpha: 0.5,
    beta_start: 0.4,
    beta_end: 1.0,
    beta_updates: 1,
};

/// Batches of recorded frames a second, and as many bytes merely copied.
pub(super) fn assembling(recording: &Recording, bench: &mut Bench<'_>) -> anyhow::Result<()> {
    let config = settings::of_run(settings::WORLD, AGENT, "paper", &settings::REPLAY)?;
    let (rows, frame_bytes) = (config.learner.batch_size, recording.frame_bytes);
    let mut filled = Filled::new(&config, CAPACITY, recording)?;
    let sampling = bench.effort.rate_by_median(|| {
        black_box(filled.draw()?);
        Ok(())
    })?;
    bench.figures.found(ASSEMBLED, sampling, "batches/s");
    drop(filled);

    let held = vec![1_u8; CAPACITY as usize * frame_bytes];
    let mut rng = ChaCha8Rng::seed_from_u64(1);
    let copying = bench.effort.rate_by_median(|| {
        let mut copy = Vec::with_capacity(3 * rows as usize * frame_bytes);
        for _ in 0..3 * rows {
            let from = rng.random_range(0..CAPACITY as usize) * frame_bytes;
            copy.extend_from_slice(&held[from..from + frame_bytes]);
        }
        black_box(copy);
        Ok(())
    })?;
    bench.figures.found(COPIED, copying, "batches/s");
    Ok(())
}

/// Batches a second of a replay that holds `held` transitions: drawn uniformly, by priority, and by priorities that are then set,
/// in turn.
pub(super) fn sampling(held: u64, bench: &mut Bench<'_>) -> anyhow::Result<()> {
    let blank = Recording::blank((SIDE * SIDE) as usize);
    let filled = |sampling| {
        let mut config = settings::of_run(settings::WORLD, AGENT, "paper", &settings::REPLAY)?;
        (config.run.frame_height, config.run.frame_width) = (SIDE, SIDE);
        config.run.frame_channels = 1;
        config.replay.capacity_transitions = held;
        config.replay.sampling = sampling;
        Filled::new(&config, held, &blank)
    };
    let mut uniform = filled(Sampling::Uniform {})?;
    let mut prioritised = filled(PRIORITISED)?;
    let mut learned_from = filled(PRIORITISED)?;
    let rows = uniform.rows;
    // Most transitions have a priority of their own, as after a while of learning.
    for _ in 0..2 * held / u64::from(rows) {
        prioritised.learn()?;
        learned_from.learn()?;
    }
    let names = [
        "drawn uniformly",
        "drawn by priority",
        "drawn by priority, and priorities set",
    ];
    let mut works: [Work<'_>; 3] = [
        Box::new(|| uniform.draw().map(|batch| drop(black_box(batch)))),
        Box::new(|| prioritised.draw().map(|batch| drop(black_box(batch)))),
        Box::new(|| learned_from.learn()),
    ];
    for (what, rate) in names.iter().zip(bench.effort.rates_in_turn(&mut works)?) {
        let what = format!("{rows} rows of {held} transitions {what}");
        bench.figures.found(what, rate, "batches/s");
    }
    Ok(())
}

/// A replay that is full, and what its learner finds.
struct Filled {
    replay: Replay,
    rows: u32,
    updates: u64,
    rng: ChaCha8Rng,
}

impl Filled {
    /// A replay with the chunks of one actor, until it has stored more than `held` transitions.
    fn new(config: &RunConfig, held: u64, recording: &Recording) -> anyhow::Result<Self> {
        let mut chunks = recording.chunks(0, CHUNKS[3], BufferPool::new(1));
        let rows = config.learner.batch_size;
        let mut replay = Replay::new(&config.run, &config.replay, rows)?;
        let join = ActorJoin {
            actor: 0,
            incarnation: INCARNATION,
        };
        replay.join_actor(join).map_err(anyhow::Error::msg)?;
        while replay.inserted_total() <= held {
            let reply = replay.insert(&chunks.next_chunk());
            ensure!(matches!(reply, InsertReply::Stored { .. }), "{reply:?}");
        }
        Ok(Self {
            replay,
            rows,
            updates: 0,
            rng: ChaCha8Rng::seed_from_u64(1),
        })
    }

    fn draw(&mut self) -> anyhow::Result<Batch> {
        let batch = self.replay.sample(self.rows);
        batch.map_err(|why| anyhow!("no batch: {why:?}"))
    }

    /// Draws a batch and sets its rows' priorities.
    fn learn(&mut self) -> anyhow::Result<()> {
        let batch = self.draw()?;
        let found: Vec<f32> = (0..self.rows).map(|_| self.rng.random()).collect();
        self.updates += 1;
        if let Some(update) = batch.priority_update(1, self.updates, &found) {
            let set = self.replay.set_priorities(&update);
            set.map_err(anyhow::Error::msg)?;
        }
        Ok(())
    }
}
