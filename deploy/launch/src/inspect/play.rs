//! What the rows of a run's batches hold, found by playing: actor and replay as in lockstep, with weights that stay as they start.
//! It learns nothing, so an agent that has learned to live longer, or to stand still, has other shares.

use std::collections::HashSet;

use anyhow::bail;
use driml_actor::{ActorSettings, Collector, Incarnation};
use driml_learner::{Compute, EqualStates, Learner, LearnerConfig, Positives};
use driml_protocol::{ActorJoin, Batch, BatchHeader, BufferPool, InsertReply};
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
    /// Bytes that it would have if each state came with all its frames, and does not have, as another state has them, less those
    /// that say which frames are whose; 0 where a state is one frame.
    pub shared_bytes: f64,
    /// Of a batch's states s_t and s_{t+k}, those that are equal to another of them.
    pub repeated_online: f64,
    /// Of a batch's states s_{t+n}, those that are equal to another of them.
    pub repeated_target: f64,
    /// States that pass through the online network for their features, of those that would if none were left out.
    pub computed_online: f64,
    /// The same of states s_{t+n} and the target network.
    pub computed_target: f64,
}

/// What is counted of batches.
#[derive(Default)]
struct Counts {
    rows: usize,
    bytes: usize,
    absent_bytes: usize,
    shared_bytes: usize,
    without_bootstrap: usize,
    positives: usize,
    without_positive: usize,
    online: Repeats,
    target: Repeats,
}

#[derive(Default)]
struct Repeats {
    /// States that there are.
    states: usize,
    repeated: usize,
    /// Places for states, also for those that rows do not have.
    places: usize,
    computed: usize,
}

impl Repeats {
    /// Counts the states of a pass and what a learner computes of them. `blank` of them stand for states that rows do not have.
    fn count<'a>(
        &mut self,
        states: impl Iterator<Item = &'a [u8]>,
        learner: &Learning,
        blank: usize,
    ) {
        let (mut seen, mut there) = (HashSet::new(), 0);
        for state in states {
            there += 1;
            seen.insert(state);
        }
        self.states += there;
        self.repeated += there - seen.len();
        let passed = there + blank;
        let distinct = seen.len() + usize::from(blank > 0);
        let shorter = learner.equal_once && EqualStates::pays(passed - distinct, passed);
        self.computed += if shorter { distinct } else { passed };
    }

    fn share(&self) -> f64 {
        share(self.repeated, self.states)
    }
}

/// What decides which states a learner computes.
struct Learning {
    /// Equal states once, where states are not augmented each by itself.
    equal_once: bool,
    /// A blank state is computed where a row has no positive, so that row meets row.
    blank_positives: bool,
}

impl Learning {
    fn of(config: &driml_learner::Config) -> Self {
        Self {
            equal_once: config.equal_states == EqualStates::Once && config.augment.is_none(),
            blank_positives: config.update.objective.positives() == Positives::One,
        }
    }
}

fn share(some: usize, all: usize) -> f64 {
    some as f64 / all.max(1) as f64
}

impl Counts {
    fn count(&mut self, batch: &Batch, learner: &Learning) {
        let state_bytes = batch.header.state_bytes as usize;
        let (discounts, valid) = (batch.bootstrap_discounts(), batch.positive_valid());
        let no_bootstrap = discounts.iter().filter(|discount| **discount == 0.0);
        let no_bootstrap = no_bootstrap.count();
        let no_positive = valid.iter().filter(|valid| **valid == 0).count();
        let absent_bytes = (no_bootstrap + no_positive) * state_bytes;
        let whole = BatchHeader {
            stacked: None,
            ..batch.header
        };
        let whole_bytes = whole.payload_bytes();
        self.rows += batch.rows();
        self.bytes += whole_bytes + absent_bytes;
        self.absent_bytes += absent_bytes;
        self.shared_bytes += whole_bytes.saturating_sub(batch.header.payload_bytes());
        self.without_bootstrap += no_bootstrap;
        self.positives += valid.len();
        self.without_positive += no_positive;
        let planes = [batch.states_t(), batch.states_k(), batch.states_n()];
        let states = planes
            .each_ref()
            .map(|plane| plane.chunks_exact(state_bytes));
        let [now, later, next] = states;
        let blank = if learner.blank_positives {
            no_positive
        } else {
            0
        };
        self.online.places += batch.rows() + valid.len();
        self.online.count(now.chain(later), learner, blank);
        self.target.places += batch.rows();
        self.target.count(next, learner, 0);
    }
}

/// Plays a run of these settings, and counts.
///
/// # Errors
/// A world that cannot be had or fails, a replay that refuses.
pub(super) fn play(config: &RunConfig) -> anyhow::Result<RowShares> {
    let (mut counts, learner) = (Counts::default(), Learning::of(&config.learner));
    let frames = each_batch(config, |batch| {
        counts.count(&batch, &learner);
        true
    })?;
    Ok(shares(&counts, frames))
}

/// Plays a run of these settings until `take` has enough batches or the run ends, and gives the frames that were played.
///
/// # Errors
/// A world that cannot be had or fails, a replay that refuses.
pub(super) fn each_batch(
    config: &RunConfig,
    mut take: impl FnMut(Batch) -> bool,
) -> anyhow::Result<u64> {
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
    loop {
        let chunk = actor.collect(replay.inserted_total(), steps)?;
        loop {
            match replay.insert(&chunk) {
                InsertReply::Stored { .. } | InsertReply::Finished { .. } => break,
                InsertReply::Wait { .. } => match replay.sample(rows) {
                    Ok(batch) => {
                        if !take(batch) {
                            return Ok(replay.inserted_total());
                        }
                    }
                    Err(unready) => bail!("actor and replay wait for each other: {unready:?}"),
                },
                refused => bail!("the replay refused a chunk: {refused:?}"),
            }
        }
        loop {
            match replay.sample(rows) {
                Ok(batch) => {
                    if !take(batch) {
                        return Ok(replay.inserted_total());
                    }
                }
                Err(Unready::Wait(_)) => break,
                Err(Unready::Finished) => return Ok(replay.inserted_total()),
                Err(Unready::Refused { why }) => bail!("the replay refuses to sample: {why}"),
            }
        }
    }
}

fn shares(counts: &Counts, frames: u64) -> RowShares {
    RowShares {
        frames,
        rows: counts.rows as u64,
        without_bootstrap: share(counts.without_bootstrap, counts.rows),
        without_positive: share(counts.without_positive, counts.positives),
        absent_bytes: share(counts.absent_bytes, counts.bytes),
        shared_bytes: share(counts.shared_bytes, counts.bytes),
        repeated_online: counts.online.share(),
        repeated_target: counts.target.share(),
        computed_online: share(counts.online.computed, counts.online.places),
        computed_target: share(counts.target.computed, counts.target.places),
    }
}

#[cfg(test)]
mod tests {
    use driml_protocol::{Buffer, RowScalars};

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
            origin: None,
            stacked: None,
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
        let learner = Learning {
            equal_once: true,
            blank_positives: true,
        };
        counts.count(&batch, &learner);
        let each = Learning {
            equal_once: false,
            blank_positives: false,
        };
        counts.count(&batch, &each);
        assert_eq!((counts.rows, counts.without_bootstrap), (8, 2));
        assert_eq!((counts.positives, counts.without_positive), (8, 4));
        // Of 1, 1, 3, 4, 2, 1 two are repeated, of 99, 99, 98 one.
        assert_eq!((counts.online.states, counts.online.repeated), (12, 4));
        assert_eq!((counts.target.states, counts.target.repeated), (6, 2));
        // At first 1, 3, 4, 2 and a blank one are computed for eight places, then each of the six that are there.
        assert_eq!((counts.online.places, counts.online.computed), (16, 5 + 6));
        assert_eq!((counts.target.places, counts.target.computed), (8, 2 + 3));
        assert_eq!(counts.bytes, 2 * 4 * (3 * 2 + 12));
        assert_eq!((counts.absent_bytes, counts.shared_bytes), (2 * 3 * 2, 0));
    }
}
