//! What the rows of a run's batches hold, found by playing: actor and replay as in lockstep, with weights that stay as they start.
//! It learns nothing, so an agent that has learned to live longer, or to stand still, has other shares.

use std::collections::HashSet;

use anyhow::bail;
use driml_actor::{ActorSettings, Collector, Incarnation};
use driml_learner::{Compute, Learner, LearnerConfig};
use driml_protocol::{ActorJoin, Batch, BufferPool, InsertReply};
use driml_replay_server::{Replay, Unready};
use driml_settings::config::RunConfig;
use serde::Serialize;

/// The one actor's incarnation, which influences nothing.
const INCARNATION: u64 = 1;

/// Shares of all rows of all batches of a short run.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct RowShares {
    /// Frames that were played.
    pub frames: u64,
    /// Rows that were drawn.
    pub rows: u64,
    /// Rows whose return bootstraps from nothing: the episode ended.
    pub without_bootstrap: f64,
    /// Positives that their rows do not have; 0 where none is served.
    pub without_positive: f64,
    /// Bytes that a batch would have if every row had all of its states, and does not have.
    pub absent_bytes: f64,
    /// Of a batch's states s_t and s_{t+k}, those that are equal to another of them.
    pub repeated_online: f64,
    /// Of a batch's states s_{t+n}, those that are equal to another of them.
    pub repeated_target: f64,
}

/// What is counted of batches.
#[derive(Default)]
struct Counts {
    rows: usize,
    bytes: usize,
    absent_bytes: usize,
    without_bootstrap: usize,
    positives: usize,
    without_positive: usize,
    online: Repeats,
    target: Repeats,
}

#[derive(Default)]
struct Repeats {
    states: usize,
    repeated: usize,
}

impl Repeats {
    fn count<'a>(&mut self, states: impl Iterator<Item = &'a [u8]>) {
        let mut seen = HashSet::new();
        for state in states {
            self.states += 1;
            self.repeated += usize::from(!seen.insert(state));
        }
    }

    fn share(&self) -> f64 {
        share(self.repeated, self.states)
    }
}

fn share(some: usize, all: usize) -> f64 {
    some as f64 / all.max(1) as f64
}

impl Counts {
    fn count(&mut self, batch: &Batch) {
        let state_bytes = batch.header.state_bytes as usize;
        let (discounts, valid) = (batch.bootstrap_discounts(), batch.positive_valid());
        let no_bootstrap = discounts.iter().filter(|discount| **discount == 0.0);
        let no_bootstrap = no_bootstrap.count();
        let no_positive = valid.iter().filter(|valid| **valid == 0).count();
        let absent_bytes = (no_bootstrap + no_positive) * state_bytes;
        self.rows += batch.rows();
        self.bytes += batch.header.payload_bytes() + absent_bytes;
        self.absent_bytes += absent_bytes;
        self.without_bootstrap += no_bootstrap;
        self.positives += valid.len();
        self.without_positive += no_positive;
        let [now, later, next] = [batch.states_t(), batch.states_k(), batch.states_n()]
            .map(|plane| plane.chunks_exact(state_bytes));
        self.online.count(now.chain(later));
        self.target.count(next);
    }
}

/// Plays a run of these settings, and counts.
///
/// # Errors
/// A world that cannot be had or fails, a replay that refuses.
pub(super) fn play(config: &RunConfig) -> anyhow::Result<RowShares> {
    let text = config.to_toml();
    let settings = ActorSettings::from_toml(&text)?;
    let (rows, steps) = (config.learner.batch_size, config.actor.steps_per_chunk);
    let mut replay = Replay::new(&config.run, &config.replay, rows)?;
    let join = ActorJoin {
        actor: 0,
        incarnation: INCARNATION,
    };
    replay.join_actor(join).map_err(anyhow::Error::msg)?;
    let mut learner = Learner::new(LearnerConfig::from_toml(&text)?, &Compute::CPU)?;
    let weights = learner.next_weights()?;
    let life = Incarnation {
        actor: 0,
        id: INCARNATION,
        after_updates: 0,
        earlier_incarnations: 0,
    };
    let (pool, version) = (BufferPool::new(1), weights.header.version);
    let mut actor = Collector::new(settings, pool, life, version, &weights.safetensors)?;
    let mut counts = Counts::default();
    loop {
        let chunk = actor.collect(replay.inserted_total(), steps)?;
        loop {
            match replay.insert(&chunk) {
                InsertReply::Stored { .. } | InsertReply::Finished { .. } => break,
                InsertReply::Wait { .. } => match replay.sample(rows) {
                    Ok(batch) => counts.count(&batch),
                    Err(unready) => bail!("actor and replay wait for each other: {unready:?}"),
                },
                refused => bail!("the replay refused a chunk: {refused:?}"),
            }
        }
        loop {
            match replay.sample(rows) {
                Ok(batch) => counts.count(&batch),
                Err(Unready::Wait(_)) => break,
                Err(Unready::Finished) => return Ok(shares(&counts, &replay)),
                Err(Unready::Refused { why }) => bail!("the replay refuses to sample: {why}"),
            }
        }
    }
}

fn shares(counts: &Counts, replay: &Replay) -> RowShares {
    RowShares {
        frames: replay.inserted_total(),
        rows: counts.rows as u64,
        without_bootstrap: share(counts.without_bootstrap, counts.rows),
        without_positive: share(counts.without_positive, counts.positives),
        absent_bytes: share(counts.absent_bytes, counts.bytes),
        repeated_online: counts.online.share(),
        repeated_target: counts.target.share(),
    }
}

#[cfg(test)]
mod tests {
    use driml_protocol::{BatchHeader, Buffer, RowScalars};

    use super::*;

    #[test]
    fn rows_are_counted_as_they_are() {
        let header = BatchHeader {
            rows: 4,
            positives: 1,
            state_bytes: 2,
            states_k: 0,
            states_n: 0,
            tally: Default::default(),
            held: 0,
            mean_age: 0.0,
            weights_versions: (0, 0),
        };
        let states = [
            ([1, 1], Some([9, 9]), Some([2, 2])),
            ([1, 1], Some([9, 9]), Some([1, 1])),
            ([3, 3], Some([9, 8]), None),
            ([4, 4], None, None),
        ];
        let rows = states.map(|(_, next, later)| RowScalars {
            action: 0,
            next_action: 0,
            n_step_return: 0.0,
            bootstrap_discount: if next.is_some() { 0.9 } else { 0.0 },
            positives: later.iter().len() as u32,
            k_first: 1,
        });
        let mut batch = Batch::of_rows(header, &rows, Buffer::zeroed);
        let mut places = batch.states_mut();
        for (row, (now, next, later)) in states.into_iter().enumerate() {
            places.t(row).copy_from_slice(&now);
            if let (Some(place), Some(next)) = (places.n(row), next) {
                place.copy_from_slice(&next);
            }
            if let (Some(place), Some(later)) = (places.k(0, row), later) {
                place.copy_from_slice(&later);
            }
        }
        let mut counts = Counts::default();
        counts.count(&batch);
        counts.count(&batch);
        assert_eq!((counts.rows, counts.without_bootstrap), (8, 2));
        assert_eq!((counts.positives, counts.without_positive), (8, 4));
        // Of 1, 1, 3, 4, 2, 1 two are repeated, of 99, 99, 98 one.
        assert_eq!((counts.online.states, counts.online.repeated), (12, 4));
        assert_eq!((counts.target.states, counts.target.repeated), (6, 2));
        assert_eq!(counts.bytes, 2 * 4 * (3 * 2 + 12));
        assert_eq!(counts.absent_bytes, 2 * 3 * 2);
    }
}
