//! Calls of tests to a replay, and the expected replies.

use driml_protocol::{
    ActorJoin, AffinityUpdate, Chunk, ChunkHeader, Horizon, InsertReply, LearnerJoin,
    LearnerProgress, Leave, RunSpec, Sampling, ShardCounts,
};
use driml_replay_server::{Config, Replay};

use crate::history::spec;

pub(crate) fn small_spec() -> RunSpec {
    spec(3, 1, 1, Horizon::None {})
}

/// Creates a replay of `small_spec`, for batches of 8 rows.
pub(crate) fn small_replay(config: &Config) -> Replay {
    Replay::new(&small_spec(), config, 8).unwrap()
}

/// Returns settings with 4 rows for each transition, and actors that are at most `slack_transitions` ahead.
pub(crate) fn limited(slack_transitions: u64) -> Config {
    Config {
        replay_ratio: 4.0,
        slack_transitions,
        ..Config::unlimited(1000)
    }
}

/// Returns settings with priorities, and with limits at which neither side ever waits.
pub(crate) fn prioritised(capacity: u64, alpha: f64) -> Config {
    Config {
        sampling: Sampling::Prioritised {
            alpha,
            beta_start: 0.4,
            beta_end: 1.0,
            beta_updates: 100,
        },
        ..Config::unlimited(capacity)
    }
}

/// Returns the header of a chunk with frames as in `small_spec` and other runs of three channels.
pub(crate) fn header(
    actor: u32,
    incarnation: u64,
    sequence: u64,
    first_transition: u64,
) -> ChunkHeader {
    ChunkHeader {
        actor,
        incarnation,
        sequence,
        first_transition,
        streams: 2,
        steps: 3,
        frame_bytes: small_spec().frame_bytes() as u32,
        ..ChunkHeader::default()
    }
}

/// An actor, by the header of its next chunk.
pub(crate) struct Actor {
    pub(crate) next: ChunkHeader,
}

impl Actor {
    pub(crate) fn new(actor: u32, incarnation: u64) -> Self {
        let next = header(actor, incarnation, 0, 0);
        Self { next }
    }

    /// Returns the header of the actor's next chunk, and counts the chunk as sent.
    pub(crate) fn send(&mut self, streams: u32, steps: u32) -> ChunkHeader {
        (self.next.streams, self.next.steps) = (streams, steps);
        let sent = self.next;
        self.next.sequence += 1;
        self.next.first_transition += sent.transitions() as u64;
        sent
    }

    pub(crate) const fn leave(&self) -> Leave {
        let next = &self.next;
        Leave::new(next.actor, next.incarnation, next.first_transition)
    }
}

pub(crate) fn join(replay: &mut Replay, actor: u32, incarnation: u64) {
    replay.join_actor(ActorJoin { actor, incarnation }).unwrap();
}

pub(crate) const fn affinity(version: u64, matrix: Vec<f32>) -> AffinityUpdate {
    AffinityUpdate {
        learner: 1,
        version,
        matrix,
    }
}

pub(crate) const fn learned(updates: u64, saved: u64, rows: u64) -> LearnerProgress {
    LearnerProgress {
        updates,
        saved_updates: saved,
        rows_received: rows,
    }
}

/// Inserts a chunk. If its actor is new, the actor joins first.
pub(crate) fn insert(replay: &mut Replay, header: ChunkHeader) -> InsertReply {
    if replay.actor_incarnation(header.actor).is_none() {
        join(replay, header.actor, header.incarnation);
    }
    let reply = replay.insert(&Chunk::zeroed(header));
    replay.check_valid();
    reply
}

pub(crate) const fn stored(inserted_total: u64) -> InsertReply {
    InsertReply::Stored {
        inserted_total,
        actors: 0,
        waited: false,
    }
}

pub(crate) fn is_stored(reply: &InsertReply) -> bool {
    matches!(reply, InsertReply::Stored { .. })
}

pub(crate) const fn wait(inserted_total: u64) -> InsertReply {
    InsertReply::Wait {
        inserted_total,
        kept: false,
    }
}

pub(crate) fn is_refused(reply: &InsertReply) -> bool {
    matches!(reply, InsertReply::Refused { .. })
}

/// Returns the join of a learner of run 1 with `updates` updates and `rows` rows learned, when `inserted` transitions were stored.
pub(crate) fn learner(learner: u64, updates: u64, rows: u64, inserted: u64) -> LearnerJoin {
    LearnerJoin {
        learner,
        run: 1,
        updates,
        counts: ShardCounts::new(inserted, rows),
        ..LearnerJoin::default()
    }
}
