//! The counters and means that processes report on request, but no data.
//! Each process fills in its own values; only merges of shards and derived values are computed here.

use serde::{Deserialize, Serialize};

/// Which side waits for the other at the rate limiter.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub enum Waiting {
    /// Neither side waits.
    #[default]
    Neither,
    /// The learner waits for the first transitions.
    WarmUp {
        /// Transitions stored so far.
        have: u64,
        /// Transitions needed before the first batch.
        need: u64,
    },
    /// The learner waits: all rows that the replay ratio allows were sampled.
    LearnerWaitsForActors,
    /// The actors wait: as many transitions are stored as the replay ratio allows.
    ActorsWaitForLearner,
    /// Neither side waits: all transitions are stored and their rows sampled.
    Finished,
}

impl std::fmt::Display for Waiting {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Neither => f.write_str("neither side waits"),
            Self::WarmUp { have, need } => write!(f, "warm-up {have}/{need}"),
            Self::LearnerWaitsForActors => f.write_str("learner waits for actors"),
            Self::ActorsWaitForLearner => f.write_str("actors wait for learner"),
            Self::Finished => f.write_str("all sampled"),
        }
    }
}

/// Episodes over which a mean return is taken.
pub const RETURNS_MAX: usize = 100;

/// Returns of the episodes that ended last.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Returns {
    /// Episodes since the start whose return is known, because no part of them was lost.
    pub known: u64,
    /// Undiscounted returns of the newest of these episodes, oldest first; at most [`RETURNS_MAX`] per shard.
    pub newest: Vec<f64>,
}

impl Returns {
    /// Mean of the newest returns; `None` before the first.
    pub fn mean(&self) -> Option<f64> {
        let sum: f64 = self.newest.iter().sum();
        (!self.newest.is_empty()).then(|| sum / self.newest.len() as f64)
    }
}

/// How a quantity was distributed since the start.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Quantiles {
    /// The median of all values since the start.
    pub p50: f64,
    /// The value that 99% of all values do not exceed.
    pub p99: f64,
    /// The largest value since the start.
    pub max: f64,
}

impl Quantiles {
    /// The larger value of each field, or the only one of the two.
    fn worst(one: Option<Self>, other: Option<Self>) -> Option<Self> {
        let (Some(one), Some(other)) = (one, other) else {
            return one.or(other);
        };
        Some(Self {
            p50: one.p50.max(other.p50),
            p99: one.p99.max(other.p99),
            max: one.max.max(other.max),
        })
    }
}

/// The counters and means of a replay server. Values that were not recorded may be missing in a run's summary.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct ReplayStatus {
    /// Transitions stored since the start of the run, without those in `transitions_refilled`.
    pub transitions_inserted: u64,
    /// Transitions that filled the memory again after the run was resumed without its replay.
    pub transitions_refilled: u64,
    /// Transitions held now, from which rows can be drawn: 0 while a replay fills its memory again, and after a draw that found no anchor
    /// until the next chunk.
    pub transitions_held: u64,
    /// Bytes of memory that the frames of these transitions take.
    pub frame_bytes_held: u64,
    /// Transitions that actors produced and that never arrived.
    pub transitions_lost: u64,
    /// Transitions stored twice.
    pub transitions_duplicated: u64,
    /// Chunks recognised as a retry of a stored one, and not stored again.
    pub chunks_retried: u64,
    /// Batches that did not reach the learner, which requested them again; not counted as served.
    pub batches_retried: u64,
    /// Messages rejected as malformed or foreign, or because their sender's role may not send them.
    pub messages_refused: u64,
    /// Rows served since the start.
    pub rows_sampled: u64,
    /// Rows served to a learner that died before it saved what it learned from them; not counted as sampled.
    pub rows_unlearned: u64,
    /// Updates since the start of the run, as the learner last reported.
    pub updates: u64,
    /// Updates that were repeated because the learner resumed from an older checkpoint.
    pub updates_relearned: u64,
    /// Transitions stored before the first row could be sampled.
    pub warmup_transitions: u64,
    /// Episodes that ended.
    pub episodes: u64,
    /// Returns of the last 100 episodes.
    pub returns: Returns,
    /// How often each k was served; index 0 counts rows without a positive. A row of several positives counts once, under
    /// its furthest.
    pub k_histogram: Vec<u64>,
    /// Mean age of the rows of the last batches, in transitions stored since. One shard counts only those that it stored.
    pub mean_age: f64,
    /// How often each action was stored.
    pub action_histogram: Vec<u64>,
    /// Which side waits now.
    pub waiting: Waiting,
    /// Seconds that requests for a batch spent waiting at the limiter.
    pub learner_waited_s: f64,
    /// Seconds that chunks spent waiting at the limiter.
    pub actors_waited_s: f64,
    /// Number of connected actors.
    pub actors: u32,
    /// Number of actors that have sent a chunk.
    pub actors_acting: u32,
    /// Number of actors whose next chunk waits until the rate limiter lets it in.
    pub actors_waiting: u32,
    /// Milliseconds from a chunk or a question about one to its reply, even if the reply is only that the chunk waits.
    pub answer_ms: Option<Quantiles>,
    /// Milliseconds from a chunk's arrival until it was stored.
    pub insert_ms: Option<Quantiles>,
    /// Seconds for which newer weights had existed when a chunk was stored; 0 if the newest weights chose its actions.
    pub weights_behind_s: Option<Quantiles>,
    /// Updates by which the weights that chose a chunk's actions were behind the newest when the chunk was stored.
    pub weights_behind_updates: Option<Quantiles>,
    /// Version of the affinity matrix in use; 0 for the uniform one.
    pub affinity_version: u64,
    /// Whether all transitions are stored.
    pub finished: bool,
    /// Whether the learner has learned from every batch and has saved.
    pub learner_finished: bool,
}

impl ReplayStatus {
    /// Merges the statuses of all shards. The newest returns of the shards follow one another; the mean age is weighted by rows, and
    /// in transitions of all shards, of which each stores its share.
    pub fn merged(shards: &[Self]) -> Self {
        let Some((first, others)) = shards.split_first() else {
            return Self::default();
        };
        let mut sum = first.clone();
        others.iter().for_each(|it| sum.add_shard(it));
        let stored = |it: &Self| it.transitions_inserted.max(1) as f64;
        let age = |it: &Self| it.mean_age * (stored(&sum) / stored(it)) * it.rows_sampled as f64;
        let ages: f64 = shards.iter().map(age).sum();
        sum.mean_age = match sum.rows_sampled {
            0 => 0.0,
            rows => ages / rows as f64,
        };
        sum
    }

    /// Adds another shard's status, except for the mean age. Every shard has the warm-up of the whole run.
    fn add_shard(&mut self, it: &Self) {
        macro_rules! add {
            ($($count:ident)+) => {
                $(self.$count = self.$count.saturating_add(it.$count);)+
            };
        }
        add! {
            transitions_inserted transitions_refilled transitions_held frame_bytes_held transitions_lost transitions_duplicated
            chunks_retried batches_retried messages_refused rows_sampled rows_unlearned episodes
            actors actors_acting actors_waiting
        }
        self.returns.known = self.returns.known.saturating_add(it.returns.known);
        for (sums, counts) in [
            (&mut self.k_histogram, &it.k_histogram),
            (&mut self.action_histogram, &it.action_histogram),
        ] {
            let each = sums.iter_mut().zip(counts);
            each.for_each(|(sum, n)| *sum = sum.saturating_add(*n));
        }
        for (worst, other) in [
            (&mut self.answer_ms, it.answer_ms),
            (&mut self.insert_ms, it.insert_ms),
            (&mut self.weights_behind_s, it.weights_behind_s),
            (&mut self.weights_behind_updates, it.weights_behind_updates),
        ] {
            *worst = Quantiles::worst(*worst, other);
        }
        // Each shard learns these counts with the learner's next request.
        self.updates = self.updates.max(it.updates);
        self.updates_relearned = self.updates_relearned.max(it.updates_relearned);
        self.returns.newest.extend(&it.returns.newest);
        self.learner_waited_s += it.learner_waited_s;
        self.actors_waited_s += it.actors_waited_s;
        self.affinity_version = self.affinity_version.min(it.affinity_version);
        // A shard knows of the others only what the learner told it. If one knows of the end, it is right.
        self.finished |= it.finished;
        self.learner_finished |= it.learner_finished;
        if it.waiting == Waiting::Finished || self.waiting == Waiting::Neither {
            self.waiting = it.waiting;
        }
    }

    /// Rows sampled per transition inserted after the warm-up; `None` before.
    pub fn replay_ratio(&self) -> Option<f64> {
        let after = self
            .transitions_inserted
            .checked_sub(self.warmup_transitions)?;
        (after > 0).then(|| self.rows_sampled as f64 / after as f64)
    }

    /// Mean k of the furthest positive, over the rows served with a positive; `None` before the first.
    pub fn mean_k(&self) -> Option<f64> {
        // The counts come from another process and may have any value.
        let counts = || self.k_histogram.iter().map(|&n| u128::from(n));
        let positives: u128 = counts().skip(1).sum();
        let weighted: u128 = (0_u128..).zip(counts()).map(|(k, n)| k * n).sum();
        (positives > 0).then(|| weighted as f64 / positives as f64)
    }

    /// Standard deviation of k of the furthest positive, over the rows served with a positive; `None` before the first.
    pub fn sd_k(&self) -> Option<f64> {
        let mean = self.mean_k()?;
        let served = || self.k_histogram.iter().enumerate().skip(1);
        let squares: f64 = served()
            .map(|(k, &n)| (k as f64 - mean).powi(2) * n as f64)
            .sum();
        let positives: u128 = served().map(|(_, &n)| u128::from(n)).sum();
        Some((squares / positives as f64).sqrt())
    }
}

/// The counters and means of the learner.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct LearnerStatus {
    /// Updates done since the start of the run.
    pub updates: u64,
    /// C51 loss of the last update.
    pub c51_kl: f32,
    /// Auxiliary losses of the last update by name, without those that have no weight in the agent's loss.
    pub losses: Vec<(String, f32)>,
    /// Total loss of the last update.
    pub total: f32,
    /// Global gradient norm of the last update, before clipping.
    pub grad_norm: f64,
    /// Mean over the last update's rows of the taken action's value.
    pub q_mean: f32,
    /// Version of the newest weights.
    pub weights_version: u64,
    /// SHA-256 of the newest weights, hexadecimal.
    pub weights_sha256: String,
    /// Seconds spent computing updates.
    pub computing_s: f64,
    /// Seconds spent waiting for a batch.
    pub waiting_s: f64,
    /// Whether the last checkpoint is written and nothing is left to do.
    pub finished: bool,
}

impl LearnerStatus {
    /// The auxiliary loss of this name, if the last update had one.
    pub fn loss(&self, name: &str) -> Option<f32> {
        let found = self.losses.iter().find(|(known, _)| known == name);
        found.map(|(_, loss)| *loss)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A status in which no field has its default. All fields are named, so that a new one is not forgotten where shards are merged.
    fn full(n: u64) -> ReplayStatus {
        let quantiles = |what: u64| {
            // The first shard has the worse median; the second has the worse p99 and maximum.
            let p50 = if n == 1 { 9_000.0 } else { 8_000.0 };
            let (p99, max) = ((what * n) as f64, (2 * what * n) as f64);
            (n < 3).then_some(Quantiles { p50, p99, max })
        };
        ReplayStatus {
            transitions_inserted: n,
            transitions_refilled: 26 * n,
            transitions_held: 2 * n,
            frame_bytes_held: 3 * n,
            transitions_lost: 4 * n,
            transitions_duplicated: 5 * n,
            chunks_retried: 6 * n,
            batches_retried: 7 * n,
            messages_refused: 8 * n,
            rows_sampled: 9 * n,
            rows_unlearned: 19 * n,
            updates: 27 * n,
            updates_relearned: 28 * n,
            warmup_transitions: 1_000,
            episodes: 10 * n,
            returns: Returns {
                known: 11 * n,
                newest: vec![n as f64; 2],
            },
            k_histogram: vec![n, 12 * n],
            mean_age: 13.0 * n as f64,
            action_histogram: vec![14 * n, n],
            waiting: match n {
                1 => Waiting::ActorsWaitForLearner,
                _ => Waiting::Finished,
            },
            learner_waited_s: 15.0 * n as f64,
            actors_waited_s: 16.0 * n as f64,
            actors: 17 * n as u32,
            actors_acting: 21 * n as u32,
            actors_waiting: 20 * n as u32,
            answer_ms: quantiles(22),
            insert_ms: quantiles(23),
            weights_behind_s: quantiles(24),
            weights_behind_updates: quantiles(25),
            affinity_version: 18 * n,
            finished: n == 2,
            learner_finished: n == 2,
        }
    }

    #[test]
    fn every_field_of_every_shard_counts() {
        assert_eq!(ReplayStatus::merged(&[]), ReplayStatus::default());
        assert_eq!(ReplayStatus::merged(&[full(1)]), full(1));
        let merged = ReplayStatus::merged(&[full(1), full(2)]);
        let worst = |what: u64| {
            Some(Quantiles {
                p50: 9_000.0,
                p99: (2 * what) as f64,
                max: (4 * what) as f64,
            })
        };
        let expected = ReplayStatus {
            warmup_transitions: 1_000,
            returns: Returns {
                known: 33,
                newest: vec![1.0, 1.0, 2.0, 2.0],
            },
            // 9 rows of age 13 in the shard that stored a third of the transitions, 18 of age 26 in the other.
            mean_age: (9.0 * 13.0 * 3.0 + 18.0 * 26.0 * 1.5) / 27.0,
            waiting: Waiting::Finished,
            // The older matrix of the two shards.
            affinity_version: 18,
            updates: 54,
            updates_relearned: 56,
            answer_ms: worst(22),
            insert_ms: worst(23),
            weights_behind_s: worst(24),
            weights_behind_updates: worst(25),
            finished: true,
            learner_finished: true,
            ..full(3)
        };
        assert_eq!(merged, expected);
        assert_eq!(merged.returns.mean(), Some(1.5));
        assert_eq!(Returns::default().mean(), None);
        // Counts from another process may have any value.
        let most = ReplayStatus {
            k_histogram: vec![0, u64::MAX, u64::MAX],
            ..merged
        };
        assert_eq!((most.mean_k(), most.sd_k()), (Some(1.5), Some(0.5)));
    }
}
