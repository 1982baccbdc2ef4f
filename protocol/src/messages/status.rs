//! What the parts say of themselves when asked: counters and means, never data.
//! It computes nothing; each part fills in its own.

use serde::{Deserialize, Serialize};
use zenoh::qos::Priority;

use crate::wire::message::{Keyed, Kind, Message};

/// Who waits for whom at the rate limiter.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub enum Waiting {
    /// Neither side waits.
    #[default]
    Nobody,
    /// The learner, for the first transitions.
    WarmUp {
        /// Transitions stored so far.
        have: u64,
        /// Transitions needed before the first batch.
        need: u64,
    },
    /// The learner: all rows that the replay ratio allows were sampled.
    LearnerWaitsForActors,
    /// The actors: as many transitions are stored as the replay ratio allows.
    ActorsWaitForLearner,
    /// Nobody any more: all transitions are in and their rows sampled.
    Finished,
}

impl std::fmt::Display for Waiting {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Nobody => f.write_str("nobody waits"),
            Self::WarmUp { have, need } => write!(f, "warm-up {have}/{need}"),
            Self::LearnerWaitsForActors => f.write_str("learner waits for actors"),
            Self::ActorsWaitForLearner => f.write_str("actors wait for learner"),
            Self::Finished => f.write_str("all sampled"),
        }
    }
}

/// Episodes over which a mean return is taken.
pub const RETURNS_OF: usize = 100;

/// Returns of the episodes that ended last.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Returns {
    /// Episodes whose return is known, as all of them was seen, since the start.
    pub known: u64,
    /// Undiscounted returns of the newest of them, the oldest first; of one replay at most [`RETURNS_OF`].
    pub newest: Vec<f64>,
}

impl Returns {
    /// Mean of the newest returns; none before the first.
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
    /// What 99% do not exceed.
    pub p99: f64,
    /// The largest value since the start.
    pub max: f64,
}

impl Quantiles {
    /// The worse of each of two, where there are two.
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

/// The replay server's account of itself.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct ReplayStatus {
    /// Transitions stored since the start of the run, without those in `transitions_refilled`.
    pub transitions_inserted: u64,
    /// Transitions that filled the memory again after the run was resumed without its replay.
    pub transitions_refilled: u64,
    /// Transitions held now.
    pub transitions_held: u64,
    /// Bytes of memory that their frames take.
    pub frame_bytes_held: u64,
    /// Transitions that actors produced and that never arrived.
    pub transitions_lost: u64,
    /// Transitions stored twice.
    pub transitions_duplicated: u64,
    /// Chunks recognised as a retry of a stored one, and not stored again.
    pub chunks_retried: u64,
    /// Batches that did not reach the learner, which asked again; they do not count as served.
    pub batches_retried: u64,
    /// Messages refused as malformed or foreign, or because their sender's role may not send them.
    pub messages_refused: u64,
    /// Rows served since the start.
    pub rows_sampled: u64,
    /// Rows served to a learner that died before it saved what it learned from them; they do not count as sampled.
    pub rows_unlearned: u64,
    /// Updates since the start of the run, as the learner said last.
    pub updates: u64,
    /// Updates that were learned again, as a learner came back with an older checkpoint.
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
    /// Mean age of the rows served last, in transitions stored since theirs.
    pub mean_age: f64,
    /// How often each action was stored.
    pub action_histogram: Vec<u64>,
    /// Who waits now.
    pub waiting: Waiting,
    /// Seconds that requests for a batch spent waiting at the limiter.
    pub learner_waited_s: f64,
    /// Seconds that chunks spent waiting at the limiter.
    pub actors_waited_s: f64,
    /// Actors that are connected.
    pub actors: u32,
    /// Actors of which a chunk has come.
    pub actors_acting: u32,
    /// Actors whose next chunk waits until the rate limiter lets it in.
    pub actors_waiting: u32,
    /// Milliseconds from a question about a chunk to its answer, be it only that the chunk waits.
    pub answer_ms: Option<Quantiles>,
    /// Milliseconds from a chunk's arrival until it was stored.
    pub insert_ms: Option<Quantiles>,
    /// Seconds for which newer weights had been there when a chunk was stored; 0 where the newest ones had acted.
    pub weights_behind_s: Option<Quantiles>,
    /// Updates by which the weights that acted were behind the newest ones when their chunk was stored.
    pub weights_behind_updates: Option<Quantiles>,
    /// Version of the affinity matrix in use; 0 is the uniform one.
    pub affinity_version: u64,
    /// All transitions are in.
    pub finished: bool,
    /// The learner has learned from every batch, and has saved.
    pub learner_finished: bool,
}

impl Message for ReplayStatus {
    const KIND: Kind = Kind::ReplayStatus;
}

impl Keyed for ReplayStatus {
    const KEY: &'static str = "status/replay";
    const PRIORITY: Priority = Priority::InteractiveHigh;
}

impl ReplayStatus {
    /// The account of a replay of several shards from each shard's own. The newest returns are those of all shards, shard after
    /// shard; the mean age is weighted by rows.
    pub fn merged(shards: &[Self]) -> Self {
        let Some((first, others)) = shards.split_first() else {
            return Self::default();
        };
        let add = |sums: &mut Vec<u64>, counts: &[u64]| {
            let each = sums.iter_mut().zip(counts);
            each.for_each(|(sum, n)| *sum = sum.saturating_add(*n));
        };
        let mut sum = first.clone();
        for it in others {
            // All by name, so that a new one is not forgotten.
            let Self {
                transitions_inserted,
                transitions_refilled,
                transitions_held,
                frame_bytes_held,
                transitions_lost,
                transitions_duplicated,
                chunks_retried,
                batches_retried,
                messages_refused,
                rows_sampled,
                rows_unlearned,
                updates,
                updates_relearned,
                // Every shard has the whole run's.
                warmup_transitions: _,
                episodes,
                returns,
                k_histogram,
                // Weighted below.
                mean_age: _,
                action_histogram,
                waiting,
                learner_waited_s,
                actors_waited_s,
                actors,
                actors_acting,
                actors_waiting,
                answer_ms,
                insert_ms,
                weights_behind_s,
                weights_behind_updates,
                affinity_version,
                finished,
                learner_finished,
            } = it;
            sum.transitions_inserted = sum
                .transitions_inserted
                .saturating_add(*transitions_inserted);
            sum.transitions_refilled = sum
                .transitions_refilled
                .saturating_add(*transitions_refilled);
            sum.transitions_held = sum.transitions_held.saturating_add(*transitions_held);
            sum.frame_bytes_held = sum.frame_bytes_held.saturating_add(*frame_bytes_held);
            sum.transitions_lost = sum.transitions_lost.saturating_add(*transitions_lost);
            sum.transitions_duplicated = sum
                .transitions_duplicated
                .saturating_add(*transitions_duplicated);
            sum.chunks_retried = sum.chunks_retried.saturating_add(*chunks_retried);
            sum.batches_retried = sum.batches_retried.saturating_add(*batches_retried);
            sum.messages_refused = sum.messages_refused.saturating_add(*messages_refused);
            sum.rows_sampled = sum.rows_sampled.saturating_add(*rows_sampled);
            sum.rows_unlearned = sum.rows_unlearned.saturating_add(*rows_unlearned);
            // Each hears of them with its next request.
            sum.updates = sum.updates.max(*updates);
            sum.updates_relearned = sum.updates_relearned.max(*updates_relearned);
            sum.episodes = sum.episodes.saturating_add(*episodes);
            sum.returns.known = sum.returns.known.saturating_add(returns.known);
            sum.returns.newest.extend(&returns.newest);
            add(&mut sum.k_histogram, k_histogram);
            add(&mut sum.action_histogram, action_histogram);
            sum.learner_waited_s += learner_waited_s;
            sum.actors_waited_s += actors_waited_s;
            sum.actors = sum.actors.saturating_add(*actors);
            sum.actors_acting = sum.actors_acting.saturating_add(*actors_acting);
            sum.actors_waiting = sum.actors_waiting.saturating_add(*actors_waiting);
            sum.answer_ms = Quantiles::worst(sum.answer_ms, *answer_ms);
            sum.insert_ms = Quantiles::worst(sum.insert_ms, *insert_ms);
            sum.weights_behind_s = Quantiles::worst(sum.weights_behind_s, *weights_behind_s);
            sum.weights_behind_updates =
                Quantiles::worst(sum.weights_behind_updates, *weights_behind_updates);
            sum.affinity_version = sum.affinity_version.min(*affinity_version);
            // Each knows of the others what the learner told it; the one that knows of the end is right.
            sum.finished |= finished;
            sum.learner_finished |= learner_finished;
            if *waiting == Waiting::Finished || sum.waiting == Waiting::Nobody {
                sum.waiting = *waiting;
            }
        }
        let ages = shards.iter();
        let ages: f64 = ages.map(|it| it.mean_age * it.rows_sampled as f64).sum();
        sum.mean_age = match sum.rows_sampled {
            0 => 0.0,
            rows => ages / rows as f64,
        };
        sum
    }

    /// Rows sampled per transition inserted after the warm-up; none before.
    pub fn replay_ratio(&self) -> Option<f64> {
        let after = self
            .transitions_inserted
            .checked_sub(self.warmup_transitions)?;
        (after > 0).then(|| self.rows_sampled as f64 / after as f64)
    }

    /// Mean k, over the rows served with a positive, of the furthest; none before the first.
    pub fn mean_k(&self) -> Option<f64> {
        // Counts of another process, which may be any.
        let counts = || self.k_histogram.iter().map(|&n| u128::from(n));
        let positives: u128 = counts().skip(1).sum();
        let weighted: u128 = (0_u128..).zip(counts()).map(|(k, n)| k * n).sum();
        (positives > 0).then(|| weighted as f64 / positives as f64)
    }

    /// Standard deviation of k over all positives served; none before the first.
    pub fn sd_k(&self) -> Option<f64> {
        let mean = self.mean_k()?;
        let served = || self.k_histogram.iter().enumerate().skip(1);
        let squares: f64 = served()
            .map(|(k, &n)| (k as f64 - mean).powi(2) * n as f64)
            .sum();
        let positives: u64 = served().map(|(_, n)| n).sum();
        Some((squares / positives as f64).sqrt())
    }
}

/// The learner's account of itself.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct LearnerStatus {
    /// Updates done since the start of the run.
    pub updates: u64,
    /// C51 loss of the last update.
    pub c51_kl: f32,
    /// Auxiliary losses of the last update by name; those that the agent has no weight for are not there.
    pub losses: Vec<(String, f32)>,
    /// Total loss of the last update.
    pub total: f32,
    /// Global gradient norm of the last update, before clipping.
    pub grad_norm: f64,
    /// Mean Q value of the last update's states.
    pub q_mean: f32,
    /// Version of the newest weights.
    pub weights_version: u64,
    /// SHA-256 of the newest weights, hexadecimal.
    pub weights_sha256: String,
    /// Seconds spent computing updates.
    pub computing_s: f64,
    /// Seconds spent waiting for a batch.
    pub waiting_s: f64,
    /// The last checkpoint is written and nothing is left to do.
    pub finished: bool,
}

impl LearnerStatus {
    /// The auxiliary loss of this name, if the last update had one.
    pub fn loss(&self, name: &str) -> Option<f32> {
        let found = self.losses.iter().find(|(known, _)| known == name);
        found.map(|(_, loss)| *loss)
    }
}

impl Message for LearnerStatus {
    const KIND: Kind = Kind::LearnerStatus;
}

impl Keyed for LearnerStatus {
    const KEY: &'static str = "status/learner";
    const PRIORITY: Priority = Priority::InteractiveHigh;
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A status in which no field is zero or what it is by default.
    fn full(n: u64) -> ReplayStatus {
        let quantiles = |what: u64| {
            // The first shard's median is the worse one, the second's are the others.
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
            // 9 rows of age 13, 18 of age 26.
            mean_age: (9.0 * 13.0 + 18.0 * 26.0) / 27.0,
            waiting: Waiting::Finished,
            // The shard that has the older matrix.
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
    }
}
