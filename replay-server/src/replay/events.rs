//! What changes the replay beside chunks, as records that can be applied again: after a restart the replay is what it was.
//! Where they are kept is `durable`'s business.

use driml_protocol::{ActorJoin, AffinityUpdate, Goodbye, RequestId, Tally};
use serde::{Deserialize, Serialize};

use super::Replay;
use crate::storage::frame_store::PackedChunk;

/// One change of the replay. A chunk is one too, and is kept as the message that it came in.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) enum Event {
    /// [`Replay::join_actor`].
    ActorJoined(ActorJoin),
    /// [`Replay::goodbye`].
    Goodbye(Goodbye),
    /// [`Replay::learner_starts`], and which one it is.
    LearnerStarted {
        /// The learner that is served from now on.
        learner: u64,
        /// Rows that it has learned from.
        rows_sampled: u64,
    },
    /// [`Replay::set_affinity`].
    Affinity(AffinityUpdate),
    /// [`Replay::set_other_shards`].
    OtherShards(Tally),
    /// [`Replay::draw_for`], whatever came of it.
    Drawn(Drawn),
    /// The transitions before this one were let go.
    Forgotten {
        /// The oldest that is held.
        oldest: u64,
    },
    /// Rows that the learner has learned from, whose record the disk had lost.
    ServedBefore {
        /// How many.
        rows: u64,
    },
    /// [`Replay::forget_actors`].
    ActorsForgotten(Vec<u32>),
}

/// What a request for a batch has changed. The draw itself is not repeated: it would need what the ring held then.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct Drawn {
    pub(crate) id: RequestId,
    /// The k of each row that was given; none if no batch was.
    pub(crate) ks: Vec<u32>,
    pub(crate) mean_age: f64,
    pub(crate) after: DrawPoint,
}

/// What decides the next draw, beside what is held.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct DrawPoint {
    /// How far the generator is.
    word_pos: u128,
    starving: bool,
    /// Whether the valid anchors are listed: then a draw takes other numbers from the generator.
    are_listed: bool,
    /// Changes of the ledger of requests, in this process.
    #[serde(skip)]
    requests_changes: u64,
}

impl Replay {
    /// Where the next draw stands.
    pub(crate) fn draw_point(&self) -> DrawPoint {
        DrawPoint {
            word_pos: self.rng.get_word_pos(),
            starving: self.starving,
            are_listed: self.anchors.are_listed(&self.ring),
            requests_changes: self.requests.changes(),
        }
    }

    /// Lets go of the transitions before `oldest`.
    pub(crate) fn forget_before(&mut self, oldest: u64) {
        self.ring.forget_before(oldest);
        self.forget_priorities();
    }

    /// Rows count as served that the learner has learned from.
    pub(crate) fn count_served_before(&mut self, rows: u64) {
        self.limiter.sampled_before(rows);
        let before = &mut self.resume_point.rows_sampled;
        *before = before.saturating_add(rows);
    }

    /// Applies what [`Replay::draw_for`] changed; whether the anchors are listed is the result, as the ring is not yet what it was.
    ///
    /// # Errors
    /// A k that this run does not have.
    pub(crate) fn apply_drawn(&mut self, drawn: &Drawn) -> Result<bool, String> {
        let k_max = self.statistics.k_histogram.len();
        if let Some(k) = drawn.ks.iter().find(|&&k| k as usize >= k_max) {
            return Err(format!("k = {k} of {k_max}"));
        }
        self.begin_request(drawn.id);
        if !drawn.ks.is_empty() {
            self.statistics.mean_age = drawn.mean_age;
            self.statistics.served(&drawn.ks);
            self.limiter.sampled_before(drawn.ks.len() as u64);
            self.requests.complete(drawn.id.client_id, drawn.ks.clone());
        }
        self.rng.set_word_pos(drawn.after.word_pos);
        self.starving = drawn.after.starving;
        Ok(drawn.after.are_listed)
    }

    /// Stores a chunk that was stored before.
    ///
    /// # Errors
    /// It is none of this run, or not of the actor's life that counts.
    pub(crate) fn apply_chunk(&mut self, packed: &PackedChunk<'_>) -> Result<(), String> {
        match self.unfit(&packed.chunk) {
            Some(why) => return Err(why),
            None => self.actors.check_known(&packed.chunk.header)?,
        }
        self.store(packed);
        Ok(())
    }

    /// Takes what the other shards had counted.
    pub(crate) fn apply_other_shards(&mut self, tally: Tally) {
        self.limiter.set_other_shards(tally);
    }

    /// What the other shards have counted, as far as heard.
    pub(crate) const fn other_shards(&self) -> Tally {
        self.limiter.other_shards()
    }
}
