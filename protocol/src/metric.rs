//! What the parts say of themselves when asked: counters and means, never data.
//! It computes nothing; each part fills in its own.

use serde::{Deserialize, Serialize};

/// Who waits for whom at the rate limiter.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub enum Waiting {
    /// Nobody.
    #[default]
    Nobody,
    /// The learner, for the first transitions.
    WarmUp {
        /// Transitions stored.
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
pub const RETURNS_OF: u64 = 100;

/// The replay server's account of itself.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct ReplayStatus {
    /// Transitions stored since the start.
    pub transitions_inserted: u64,
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
    /// Messages refused as malformed or foreign.
    pub messages_refused: u64,
    /// Rows served since the start.
    pub rows_sampled: u64,
    /// Rows served to a learner that died before it saved what it learned from them; they do not count as sampled.
    pub rows_unlearned: u64,
    /// Transitions stored before the first row could be sampled.
    pub warmup_transitions: u64,
    /// Episodes that ended.
    pub episodes: u64,
    /// Mean undiscounted return of the last 100 episodes; none before the first.
    pub mean_return: Option<f64>,
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
    /// Actors whose next chunk waits until the rate limiter lets it in.
    pub actors_waiting: u32,
    /// Version of the affinity matrix in use; 0 is the uniform one.
    pub affinity_version: u64,
    /// All transitions are in.
    pub finished: bool,
}

impl ReplayStatus {
    /// The account of a replay of several shards from each shard's own; of the mean age and the mean return it is the mean,
    /// weighted by rows and by episodes that count.
    pub fn merged(shards: &[Self]) -> Self {
        let Some((first, others)) = shards.split_first() else {
            return Self::default();
        };
        let weighted = |parts: &[(f64, f64)]| {
            let weight: f64 = parts.iter().map(|(_, weight)| weight).sum();
            let sum: f64 = parts.iter().map(|(value, weight)| value * weight).sum();
            (weight > 0.0).then_some(sum / weight)
        };
        let returns: Vec<_> = shards
            .iter()
            .filter_map(|it| Some((it.mean_return?, it.episodes.min(RETURNS_OF) as f64)))
            .collect();
        let ages: Vec<_> = shards
            .iter()
            .map(|it| (it.mean_age, it.rows_sampled as f64))
            .collect();
        let add = |sums: &mut Vec<u64>, counts: &[u64]| {
            sums.iter_mut().zip(counts).for_each(|(sum, n)| *sum += n);
        };
        let mut sum = first.clone();
        for it in others {
            sum.transitions_inserted += it.transitions_inserted;
            sum.transitions_held += it.transitions_held;
            sum.transitions_lost += it.transitions_lost;
            sum.transitions_duplicated += it.transitions_duplicated;
            sum.chunks_retried += it.chunks_retried;
            sum.batches_retried += it.batches_retried;
            sum.messages_refused += it.messages_refused;
            sum.rows_sampled += it.rows_sampled;
            sum.rows_unlearned += it.rows_unlearned;
            sum.episodes += it.episodes;
            add(&mut sum.k_histogram, &it.k_histogram);
            add(&mut sum.action_histogram, &it.action_histogram);
            sum.learner_waited_s += it.learner_waited_s;
            sum.actors_waited_s += it.actors_waited_s;
            sum.actors += it.actors;
            sum.affinity_version = sum.affinity_version.min(it.affinity_version);
            // Each knows of the others what the learner told it; the one that knows of the end is right.
            sum.finished |= it.finished;
            if it.waiting == Waiting::Finished || sum.waiting == Waiting::Nobody {
                sum.waiting = it.waiting;
            }
        }
        sum.mean_return = weighted(&returns);
        sum.mean_age = weighted(&ages).unwrap_or_default();
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
        let positives: u64 = self.k_histogram.iter().skip(1).sum();
        let weighted: u64 = self
            .k_histogram
            .iter()
            .enumerate()
            .map(|(k, &n)| k as u64 * n)
            .sum();
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
    /// Updates done.
    pub updates: u64,
    /// C51 loss of the last update.
    pub c51_kl: f32,
    /// DIM losses of the last update, 3t3, 3t4, 4t3, 4t4; none where lambda is 0.
    pub dim: [Option<f32>; 4],
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
