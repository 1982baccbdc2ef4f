//! The state of the replay without the transitions, as a value that is saved and restored, and the events that change it between chunks.
//! `upkeep` decides when to save a snapshot; `journal` decides where.

use driml_protocol::{ActorJoin, LearnerJoin, LearnerProgress, Leave, RunSpec, codec};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

use crate::{
    config::SHARDS_MAX,
    ledger::{actors::Actors, statistics::Statistics},
    rate_limiter::LimiterCounts,
    sampling::{horizon::Affinity, rows::RowsState},
};

/// Maximum of any count of a run.
pub(crate) const COUNT_MAX: u64 = 1 << 60;

/// The replay server's random stream under the run's seed, so that no other process draws the same numbers.
const RNG_STREAM: u64 = u64::from_be_bytes(*b"replay-1");

/// A process that joined or left: the records of the log besides chunks and snapshots.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) enum ProcessEvent {
    ActorJoined(ActorJoin),
    /// Actors that were forgotten to make room for others.
    Forgotten(Vec<u32>),
    Leave(Leave),
    LearnerJoined(LearnerJoin),
}

/// The part of a replay's state that a snapshot saves and restores unchanged.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct ReplayState {
    pub(crate) actors: Actors,
    /// The learner that is served, as it joined.
    pub(crate) learner: Option<LearnerJoin>,
    pub(crate) learned: LearnerProgress,
    /// Updates done when the run was resumed without this replay; 0 if it never was.
    pub(crate) resumed_after: u64,
    pub(crate) affinity: Affinity,
    pub(crate) rng: ChaCha8Rng,
    pub(crate) statistics: Statistics,
    /// Set if the last draw found no anchor: one chunk may then pass the limiter, as otherwise both sides would wait for each other.
    pub(crate) starving: bool,
}

impl ReplayState {
    pub(crate) fn new(spec: &RunSpec, shard: u32) -> Self {
        let mut rng = ChaCha8Rng::seed_from_u64(spec.seed);
        rng.set_stream(RNG_STREAM + u64::from(shard));
        Self {
            actors: Actors::default(),
            learner: None,
            learned: LearnerProgress::default(),
            resumed_after: 0,
            affinity: Affinity::uniform(spec.num_actions),
            rng,
            statistics: Statistics::new(spec.horizon.k_max(), spec.num_actions),
            starving: false,
        }
    }

    /// Switches to another random stream, for a shard that was resumed after `resumed` transitions or updates.
    pub(crate) fn set_rng_stream(&mut self, shard: u32, resumed: u64) {
        let stream_offset = resumed.wrapping_mul(u64::from(SHARDS_MAX));
        let stream = RNG_STREAM + u64::from(shard);
        self.rng.set_stream(stream.wrapping_add(stream_offset));
    }
}

/// The state of a replay without its transitions.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct Snapshot {
    /// Transitions stored since the start, which is the index of the next one.
    pub(crate) inserted: u64,
    pub(crate) oldest: u64,
    pub(crate) capacity: u64,
    /// The setting of this name, which is for all shards.
    pub(crate) compressed_bytes_max: Option<u64>,
    pub(crate) counts: LimiterCounts,
    pub(crate) rows: RowsState,
    pub(crate) state: ReplayState,
}

impl Snapshot {
    /// Returns the encoded size in bytes.
    pub(crate) fn bytes(&self) -> u64 {
        codec::encode_value(self).map_or(0, |it| it.len() as u64)
    }

    /// Checks the content of a snapshot, even if its checksum is right. It must fit a replay like `ours`, and counting on from it must not
    /// overflow or underflow any count. The error says what is wrong.
    pub(crate) fn check(&self, ours: &ReplayState) -> Result<(), &'static str> {
        let (inserted, counts, state) = (self.inserted, &self.counts, &self.state);
        let (counted, expected) = (&state.statistics.counted, &ours.statistics.counted);
        let num_actions = expected.action_histogram.len();
        let fits_run = state.affinity.is_for(num_actions as u32)
            && counted.action_histogram.len() == num_actions
            && counted.k_histogram.len() == expected.k_histogram.len();
        if !fits_run {
            return Err("a state of a run with other actions or another horizon");
        }
        let sum = |counts: &[u64]| counts.iter().copied().fold(0, u64::saturating_add);
        let all = [
            inserted,
            sum(&counted.k_histogram),
            counted.rows_unlearned,
            counted.episodes,
            counts.this_shard.inserted,
            counts.this_shard.rows_sampled,
            counts.refilled,
            counts.refill_left,
        ];
        if all.iter().any(|&count| count > COUNT_MAX) {
            return Err("a state with counts that no run reaches");
        }
        let is_consistent = sum(&counted.action_histogram) == inserted
            && inserted <= counts.this_shard.inserted + counts.refilled
            && self.oldest <= inserted;
        if !is_consistent {
            return Err("a state whose counts contradict each other");
        }
        state.actors.check(inserted)?;
        state.statistics.check()?;
        self.rows.check(inserted - self.oldest)
    }
}
