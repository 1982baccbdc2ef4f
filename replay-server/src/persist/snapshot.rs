//! All of the replay but the transitions themselves, as a value that is written and taken back, and what changes it between two chunks.
//! When one is written is for the facade; where it lies, for `journal`.

use std::borrow::Cow;

use driml_protocol::{ActorJoin, Chunk, ChunkHeader, Goodbye, Learned, LearnerJoin};
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

use crate::{
    ledger::{actors::Actors, statistics::Statistics},
    rate_limiter::Counts,
    replay::Replay,
    sampling::{horizon::Affinity, rows::RowsState},
};

/// Most of anything that a run counts.
const COUNT_MAX: u64 = 1 << 60;
/// Transitions of one piece of what is gone.
const GONE_PIECE: u64 = 256;

/// Who came and went: what the log holds beside chunks and snapshots.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) enum Note {
    /// [`Replay::join_actor`].
    ActorJoined(ActorJoin),
    /// [`Replay::goodbye`].
    Goodbye(Goodbye),
    /// [`Replay::join_learner`].
    LearnerJoined(LearnerJoin),
}

/// The replay without the transitions that it holds.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct Snapshot {
    /// Transitions stored since the start: the number of the next one.
    pub(crate) inserted: u64,
    /// The oldest that is held.
    pub(crate) oldest: u64,
    /// Most that are held.
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

impl Replay {
    /// Takes back a snapshot. The transitions between what is stored and those that the snapshot knows are gone: of an empty replay
    /// all, else they leave a gap, whose size is the result; 0 if it is so large that nothing before it is held.
    ///
    /// # Errors
    /// It is none of a replay of this run; the reason, for a person.
    pub(super) fn restore(&mut self, mut snapshot: Snapshot) -> Result<u64, String> {
        if let Some(why) = snapshot.unfit(&self.snapshot(), self.spec.num_actions) {
            return Err(why.into());
        }
        let (stored, inserted) = (self.ring.inserted(), snapshot.inserted);
        if self.ring.first() == stored {
            self.ring.start_at(inserted);
        } else if inserted.saturating_sub(stored) >= self.ring.capacity() {
            // Nothing that is stored would be held.
            let origin = self.origin;
            *self = Self::shard(&self.spec, &self.config, self.batch_size, origin.shard)
                .map_err(|e| e.to_string())?;
            self.origin = origin;
            self.ring.start_at(inserted);
            snapshot.actors.cut_streams(stored);
        }
        let gap = inserted.checked_sub(self.ring.inserted()).ok_or_else(|| {
            format!("a state after {inserted} transitions, where {stored} are stored")
        })?;
        if gap > 0 {
            self.push_gone(gap);
            snapshot.actors.cut_streams(stored);
        }
        self.forget_before(snapshot.oldest);
        snapshot.actors.note_restored();
        self.limiter.set_counts(snapshot.counts);
        self.restore_rows(snapshot.oldest, &snapshot.rows);
        let Snapshot {
            actors,
            learner,
            learned,
            resumed_after,
            inserted_before,
            rows_before,
            affinity,
            rng,
            statistics,
            starving,
            ..
        } = snapshot;
        (self.actors, self.learner, self.learned) = (actors, learner, learned);
        (self.resumed_after, self.starving) = (resumed_after, starving);
        (self.inserted_before, self.rows_before) = (inserted_before, rows_before);
        (self.affinity, self.rng, self.statistics) = (affinity, rng, statistics);
        self.statistics.actors = 0;
        Ok(gap)
    }

    /// Takes the place of `count` transitions that are gone.
    fn push_gone(&mut self, mut count: u64) {
        let packer = self.packer();
        while count > 0 {
            let steps = count.min(GONE_PIECE).min(self.ring.capacity());
            let chunk = Chunk::zeroed(ChunkHeader {
                actor: 0,
                incarnation: 0,
                sequence: 0,
                first_transition: 0,
                weights_version: 0,
                leaving: false,
                streams: 1,
                steps: steps as u32,
                frame_bytes: self.spec.frame_bytes() as u32,
            });
            let packed = packer.pack(Cow::Owned(chunk));
            for run in packed.runs() {
                self.ring.push_gone(run, steps);
            }
            count -= steps;
        }
    }
}
