//! All of the replay but the transitions themselves, as a value that can be kept and taken back.
//! What it is kept for, and where, is `durable`'s business.

use driml_protocol::{Chunk, ChunkHeader, Tally};
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};
use std::borrow::Cow;

use super::Replay;
use crate::{
    ledger::{actors::Actors, requests::Requests, statistics::Statistics},
    sampling::horizon::Affinity,
};

/// Most of anything that a run counts.
const COUNT_MAX: u64 = 1 << 60;
/// Transitions of one piece of what is gone.
const GONE_PIECE: u64 = 256;

/// The replay without the transitions that it holds.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct Snapshot {
    /// Transitions stored since the start: the number of the next one.
    pub(crate) inserted: u64,
    /// The oldest that is held.
    pub(crate) oldest: u64,
    /// Most that are held.
    pub(crate) capacity: u64,
    actors: Actors,
    requests: Requests,
    resume_point: Tally,
    tally: Tally,
    other_shards: Tally,
    affinity: Affinity,
    rng: ChaCha8Rng,
    statistics: Statistics,
    starving: bool,
    /// Whether the valid anchors are listed.
    pub(crate) are_listed: bool,
}

impl Replay {
    /// All of it but the transitions.
    pub(crate) fn snapshot(&self) -> Snapshot {
        Snapshot {
            inserted: self.ring.inserted(),
            oldest: self.ring.oldest(),
            capacity: self.ring.capacity(),
            actors: self.actors.clone(),
            requests: self.requests.clone(),
            resume_point: self.resume_point,
            tally: self.limiter.tally(),
            other_shards: self.limiter.other_shards(),
            affinity: self.affinity.clone(),
            rng: self.rng.clone(),
            statistics: self.statistics.logged(),
            starving: self.starving,
            are_listed: self.anchors.are_listed(&self.ring),
        }
    }

    /// Takes back a snapshot. The transitions between what is stored and those that the snapshot knows are gone: of an empty replay
    /// all, else they leave a gap, whose size is the result; 0 if it is so large that nothing before it is held.
    ///
    /// # Errors
    /// It is none of a replay of this run; the reason, for a person.
    pub(crate) fn restore(&mut self, snapshot: Snapshot) -> Result<u64, String> {
        if let Some(why) = self.unfit_state(&snapshot) {
            return Err(why.into());
        }
        let Snapshot {
            inserted,
            oldest,
            capacity: _,
            mut actors,
            requests,
            resume_point,
            tally,
            other_shards,
            affinity,
            rng,
            statistics,
            starving,
            are_listed: _,
        } = snapshot;
        let stored = self.ring.inserted();
        if self.ring.first() == stored {
            self.ring.start_at(inserted);
        } else if inserted.saturating_sub(stored) >= self.ring.capacity() {
            // Nothing that is stored would be held.
            let Self {
                spec,
                config,
                batch_size,
                origin,
                ..
            } = self;
            let mut fresh =
                Self::shard(spec, config, *batch_size, origin.shard).map_err(|e| e.to_string())?;
            fresh.origin = *origin;
            fresh.ring.start_at(inserted);
            *self = fresh;
            actors.cut_streams(stored);
        }
        let gap = inserted.checked_sub(self.ring.inserted()).ok_or_else(|| {
            format!("a state after {inserted} transitions, where {stored} are stored")
        })?;
        if gap > 0 {
            self.push_gone(gap);
            actors.cut_streams(stored);
        }
        self.forget_before(oldest);
        actors.note_restored();
        self.quiet = true;
        self.limiter = self.limiter.clone().resumed_at(tally, other_shards);
        (self.actors, self.requests, self.resume_point) = (actors, requests, resume_point);
        (self.affinity, self.rng, self.statistics) = (affinity, rng, statistics);
        self.starving = starving;
        Ok(gap)
    }

    /// Why a snapshot is none of a replay of this run, whatever its checksum says; none if it is. One that is taken can be counted on
    /// from: no count overflows, and none becomes less than nothing.
    fn unfit_state(&self, snapshot: &Snapshot) -> Option<&'static str> {
        let Snapshot {
            inserted,
            resume_point,
            tally,
            statistics,
            ..
        } = snapshot;
        let is_ours = snapshot.affinity.is_for(self.spec.num_actions)
            && statistics.k_histogram.len() == self.statistics.k_histogram.len()
            && statistics.action_histogram.len() == self.statistics.action_histogram.len();
        if !is_ours {
            return Some("a state of a run with other actions or another horizon");
        }
        let sum = |counts: &[u64]| counts.iter().copied().fold(0, u64::saturating_add);
        let served = sum(&statistics.k_histogram);
        let counts = [
            *inserted,
            served,
            statistics.rows_unlearned,
            statistics.episodes,
            resume_point.inserted,
            resume_point.rows_sampled,
            tally.inserted,
            tally.rows_sampled,
        ];
        if counts.iter().any(|&count| count > COUNT_MAX) {
            return Some("a state with counts that no run reaches");
        }
        let agrees = sum(&statistics.action_histogram) == *inserted
            && resume_point.inserted + inserted == tally.inserted
            && resume_point.rows_sampled + served == tally.rows_sampled + statistics.rows_unlearned
            && snapshot.oldest <= *inserted;
        if !agrees {
            return Some("a state whose counts contradict each other");
        }
        snapshot
            .actors
            .unfit(*inserted)
            .or_else(|| snapshot.requests.unfit(&statistics.k_histogram))
            .or_else(|| statistics.unfit())
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

    /// A snapshot of what a log brings back to the last bit.
    pub(crate) fn snapshot_of_changes(&self) -> Snapshot {
        let mut snapshot = self.snapshot();
        snapshot.statistics = snapshot.statistics.of_changes();
        snapshot
    }

    /// Ends a restoration: lists the valid anchors if they were listed.
    pub(crate) fn restored(&mut self, are_listed: bool) {
        self.statistics.actors = 0;
        self.quiet = false;
        if are_listed {
            self.anchors
                .list(&self.ring, &self.episodes, &mut self.window);
        }
    }

    /// Most transitions that are held.
    pub(crate) const fn capacity(&self) -> u64 {
        self.ring.capacity()
    }

    /// Whether the number of transitions alone decides which are held, and not how well they compress.
    pub(crate) const fn holds_by_number(&self) -> bool {
        self.config.compressed_bytes_max.is_none()
    }

    /// Transitions stored here since the start: the number of the next one.
    pub(crate) const fn next_row(&self) -> u64 {
        self.ring.inserted()
    }

    /// The oldest transition that is held.
    pub(crate) const fn oldest_row(&self) -> u64 {
        self.ring.oldest()
    }

    /// The first transition that was ever stored in this process.
    pub(crate) const fn first_row(&self) -> u64 {
        self.ring.first()
    }

    /// Actors of which a chunk has come.
    pub(crate) fn actors_delivered(&self) -> impl Iterator<Item = u32> {
        self.actors.delivered()
    }
}
