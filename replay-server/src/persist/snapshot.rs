//! All of the replay but the transitions themselves, as a value that is written and taken back, and what changes it between two chunks.
//! When one is written is for the facade; where it lies, for `journal`.

use driml_protocol::{ActorJoin, Goodbye, Learned, LearnerJoin};
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

use crate::{
    ledger::{actors::Actors, statistics::Statistics},
    rate_limiter::Counts,
    sampling::{horizon::Affinity, rows::sampler::RowsState},
};

/// Most of anything that a run counts.
const COUNT_MAX: u64 = 1 << 60;

/// Who came and went: what the log holds beside chunks and snapshots.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) enum Note {
    ActorJoined(ActorJoin),
    Goodbye(Goodbye),
    LearnerJoined(LearnerJoin),
}

/// The replay without the transitions that it holds.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct Snapshot {
    /// Transitions stored since the start: the number of the next one.
    pub(crate) inserted: u64,
    /// The oldest that is held.
    pub(crate) oldest: u64,
    pub(crate) capacity: u64,
    pub(crate) actors: Actors,
    pub(crate) learner: Option<LearnerJoin>,
    pub(crate) learned: Learned,
    pub(crate) resumed_after: u64,
    pub(crate) inserted_before: u64,
    pub(crate) rows_before: i64,
    pub(crate) counts: Counts,
    pub(crate) affinity: Affinity,
    pub(crate) rng: ChaCha8Rng,
    pub(crate) statistics: Statistics,
    pub(crate) starving: bool,
    pub(crate) rows: RowsState,
}

impl Snapshot {
    /// Why this is none of a replay like `fresh`, whatever its checksum says; none if it is. One that is taken can be counted on from:
    /// no count overflows, and none becomes less than nothing.
    pub(crate) fn unfit(&self, fresh: &Self, num_actions: u32) -> Option<&'static str> {
        let Self {
            inserted,
            counts,
            statistics,
            ..
        } = self;
        let is_ours = self.affinity.is_for(num_actions)
            && statistics.k_histogram.len() == fresh.statistics.k_histogram.len()
            && statistics.action_histogram.len() == fresh.statistics.action_histogram.len();
        if !is_ours {
            return Some("a state of a run with other actions or another horizon");
        }
        let sum = |counts: &[u64]| counts.iter().copied().fold(0, u64::saturating_add);
        let served = sum(&statistics.k_histogram);
        let counted = [
            *inserted,
            served,
            statistics.rows_unlearned,
            statistics.episodes,
            self.inserted_before,
            self.rows_before.unsigned_abs(),
            counts.this_shard.inserted,
            counts.this_shard.rows_sampled,
            counts.refilled,
            counts.refill_left,
        ];
        if counted.iter().any(|&count| count > COUNT_MAX) {
            return Some("a state with counts that no run reaches");
        }
        let rows = counts.this_shard.rows_sampled + statistics.rows_unlearned;
        let agrees = sum(&statistics.action_histogram) == *inserted
            && self.inserted_before + inserted == counts.this_shard.inserted + counts.refilled
            && self.rows_before + served as i64 == rows as i64
            && self.oldest <= *inserted;
        if !agrees {
            return Some("a state whose counts contradict each other");
        }
        self.actors
            .unfit(*inserted)
            .or_else(|| statistics.unfit())
            .or_else(|| self.rows.unfit(inserted - self.oldest))
    }
}
