//! Measures batches drawn and assembled inside the replay server, without wire and codec.
//! This bench starts no process.

use std::hint::black_box;

use anyhow::{anyhow, ensure};
use driml_machine::speed_meter::Work;
use driml_protocol::{ActorJoin, Batch, BufferPool, InsertReply, Sampling};
use driml_replay_server::Replay;
use driml_settings::config::RunConfig;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::{
    recording::{CHUNKS, INCARNATION, Recording},
    report::Bench,
    settings::{self, AGENT, CAPACITY, WORLD},
};

/// The names of [`time_assembly`]'s figures.
pub(super) const ASSEMBLY: &str = "batch of 3 states, without a wire";
pub(super) const PLAIN_COPY: &str = "plain copy of a batch's bytes";

/// The side of the black frames, in pixels: so small that the bench measures the draw, not the copying of states.
const SIDE: u32 = 8;
/// Prioritised sampling with Rainbow's alpha. Beta affects only the learner.
const PRIORITISED: Sampling = Sampling::Prioritised {
    alpha: 0.5,
    beta_start: 0.4,
    beta_end: 1.0,
    beta_updates: 1,
};

/// Measures batches of recorded frames per second, and plain copies of as many bytes.
pub(super) fn time_assembly(recording: &Recording, bench: &mut Bench<'_>) -> anyhow::Result<()> {
    let config = settings::run_config(WORLD, AGENT, "paper", &settings::REPLAY_SETS)?;
    let (rows, frame_bytes) = (config.learner.batch_size, recording.frame_bytes);
    let mut filled = FullReplay::new(&config, CAPACITY, recording)?;
    let sampling = bench.meter.rate_by_median(|| filled.draw())?;
    bench.figures.record(ASSEMBLY, sampling, "batches/s");
    drop(filled);

    let held = vec![1_u8; CAPACITY as usize * frame_bytes];
    let mut rng = ChaCha8Rng::seed_from_u64(1);
    let copying = bench.meter.rate_by_median(|| {
        let mut copy = Vec::with_capacity(3 * rows as usize * frame_bytes);
        for _ in 0..3 * rows {
            let from = rng.random_range(0..CAPACITY as usize) * frame_bytes;
            copy.extend_from_slice(&held[from..from + frame_bytes]);
        }
        Ok(copy)
    })?;
    bench.figures.record(PLAIN_COPY, copying, "batches/s");
    Ok(())
}

/// Measures batches per second of a replay that holds `held` transitions, in turn: drawn uniformly, by priority, and by priority with new
/// priorities set after each draw.
pub(super) fn time_sampling(held: u64, bench: &mut Bench<'_>) -> anyhow::Result<()> {
    let blank = Recording::blank((SIDE * SIDE) as usize);
    let filled = |sampling| {
        let mut config = settings::run_config(WORLD, AGENT, "paper", &settings::REPLAY_SETS)?;
        (config.run.frame_height, config.run.frame_width) = (SIDE, SIDE);
        config.run.frame_channels = 1;
        config.replay.capacity_transitions = held;
        config.replay.sampling = sampling;
        FullReplay::new(&config, held, &blank)
    };
    let mut uniform = filled(Sampling::Uniform {})?;
    let mut prioritised = filled(PRIORITISED)?;
    let mut updated = filled(PRIORITISED)?;
    let rows = uniform.rows;
    // Give most transitions an individual priority, as after a while of learning.
    for _ in 0..2 * held / u64::from(rows) {
        prioritised.draw_and_update()?;
        updated.draw_and_update()?;
    }
    let names = [
        "drawn uniformly",
        "drawn by priority",
        "drawn by priority, and priorities set",
    ];
    let mut works: [Work<'_>; 3] = [
        Box::new(|| uniform.draw().map(|batch| drop(black_box(batch)))),
        Box::new(|| prioritised.draw().map(|batch| drop(black_box(batch)))),
        Box::new(|| updated.draw_and_update()),
    ];
    for (what, rate) in names.iter().zip(bench.meter.rates_in_turn(&mut works)?) {
        let what = format!("{rows} rows of {held} transitions {what}");
        bench.figures.record(what, rate, "batches/s");
    }
    Ok(())
}

/// A full replay, and the state of a learner that sets priorities.
struct FullReplay {
    replay: Replay,
    rows: u32,
    updates: u64,
    rng: ChaCha8Rng,
}

impl FullReplay {
    /// Fills a replay with the chunks of one actor, until it has stored more than `held` transitions.
    fn new(config: &RunConfig, held: u64, recording: &Recording) -> anyhow::Result<Self> {
        let mut next_chunk = recording.chunks(0, CHUNKS[3], BufferPool::new(1));
        let rows = config.learner.batch_size;
        let mut replay = Replay::new(&config.run, &config.replay, rows)?;
        let join = ActorJoin::new(0, INCARNATION);
        replay.join_actor(join).map_err(anyhow::Error::msg)?;
        while replay.inserted_total() <= held {
            let reply = replay.insert(&next_chunk());
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

    fn draw_and_update(&mut self) -> anyhow::Result<()> {
        let batch = self.draw()?;
        let priorities: Vec<f32> = (0..self.rows).map(|_| self.rng.random()).collect();
        self.updates += 1;
        if let Some(update) = batch.priority_update(1, self.updates, &priorities) {
            let set = self.replay.set_priorities(&update);
            set.map_err(anyhow::Error::msg)?;
        }
        Ok(())
    }
}
