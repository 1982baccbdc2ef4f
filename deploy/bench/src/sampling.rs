//! What it costs to draw rows by priority: batches drawn uniformly, drawn by priority, and with the priorities sent back, in turn.
//! There is no wire, and frames are of 64 bytes, so that what is measured is the draw and not the copying of states.

use std::hint::black_box;

use anyhow::{anyhow, ensure};
use driml_protocol::{ActorJoin, Batch, Chunk, ChunkHeader, End, InsertReply, Sampling};
use driml_replay_server::Replay;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::{
    effort::Effort,
    measurements::Measurement,
    settings::{self, AGENT},
    taking_part::INCARNATION,
};

/// Streams and steps of a chunk.
const CHUNK: (u32, u32) = (8, 128);
/// Steps of an episode.
const EPISODE: u64 = 500;
/// Side of a frame.
const SIDE: u32 = 8;
/// Rainbow's alpha; beta is the learner's.
const PRIORITISED: Sampling = Sampling::Prioritised {
    alpha: 0.5,
    beta_start: 0.4,
    beta_end: 1.0,
    beta_updates: 1,
};

/// Batches a second of a replay that holds `held` transitions.
///
/// # Errors
/// A replay that does not store or sample.
pub(super) fn measure(effort: &Effort, held: u64) -> anyhow::Result<Vec<Measurement>> {
    let mut uniform = Filled::new(held, Sampling::Uniform)?;
    let mut prioritised = Filled::new(held, PRIORITISED)?;
    let mut learned_from = Filled::new(held, PRIORITISED)?;
    // Every transition has a priority of its own, as after a while of learning.
    for _ in 0..8 * held / u64::from(learned_from.rows) {
        prioritised.learn()?;
        learned_from.learn()?;
    }
    let rates = effort.rates_in_turn(&mut [
        &mut |_| uniform.draw().map(|batch| drop(black_box(batch))),
        &mut |_| prioritised.draw().map(|batch| drop(black_box(batch))),
        &mut |_| learned_from.learn(),
    ])?;
    let rows = uniform.rows;
    let names = [
        "drawn uniformly",
        "drawn by priority",
        "drawn by priority, and priorities set",
    ];
    let name = |what| format!("{rows} rows of {held} transitions {what}");
    let figures = names.into_iter().zip(rates);
    Ok(figures
        .map(|(what, rate)| Measurement::found(name(what), rate, "batches/s"))
        .collect())
}

/// A replay that is full, and what its learner finds.
struct Filled {
    replay: Replay,
    rows: u32,
    updates: u64,
    rng: ChaCha8Rng,
}

impl Filled {
    fn new(held: u64, sampling: Sampling) -> anyhow::Result<Self> {
        let mut config = settings::of_run(settings::WORLD, AGENT, "paper", &settings::REPLAY)?;
        (config.run.frame_height, config.run.frame_width) = (SIDE, SIDE);
        config.run.frame_channels = 1;
        config.replay.capacity_transitions = held;
        config.replay.sampling = sampling;
        let rows = config.learner.batch_size;
        let mut replay = Replay::new(&config.run, &config.replay, rows)?;
        let join = ActorJoin {
            actor: 0,
            incarnation: INCARNATION,
        };
        replay.join_actor(join).map_err(anyhow::Error::msg)?;
        let (streams, steps) = CHUNK;
        let transitions = u64::from(streams * steps);
        for sequence in 0..held.div_ceil(transitions) + 1 {
            let mut chunk = Chunk::zeroed(ChunkHeader {
                actor: 0,
                incarnation: INCARNATION,
                sequence,
                first_transition: sequence * transitions,
                weights_version: 0,
                leaving: false,
                streams,
                steps,
                frame_bytes: SIDE * SIDE,
            });
            for row in 0..streams * steps {
                let step = sequence * u64::from(steps) + u64::from(row % steps);
                let ends = (step + 1).is_multiple_of(EPISODE);
                let end = if ends { End::Terminal } else { End::Running };
                chunk.set(row as usize, 0, 0.0, end);
            }
            let reply = replay.insert(&chunk);
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
