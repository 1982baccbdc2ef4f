//! What the replay server says of a chunk, and an actor's question about one that has to wait.
//! Whether a chunk is stored is the replay server's decision.

use serde::{Deserialize, Serialize};

/// Asks what became of a chunk that the replay server keeps until its limiter opens: the chunk's header without its payload.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct ChunkPoll {
    /// The actor's number in the run.
    pub actor: u32,
    /// Which life of that actor.
    pub incarnation: u64,
    /// Number of the chunk within the incarnation.
    pub sequence: u64,
    /// The actor was told to stop: the rate limiter lets the chunk pass.
    pub leaving: bool,
}

/// The replay server's answer to a chunk or a poll.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub enum InsertReply {
    /// Stored, now or by an earlier try: the actor may forget it.
    Stored {
        /// Transitions that the run has stored.
        inserted_total: u64,
        /// Actors that are connected, by which they choose the length of their chunks.
        actors: u32,
        /// Whether the chunk had to wait for the rate limiter.
        waited: bool,
    },
    /// Not stored yet: the rate limiter has no room.
    Wait {
        /// Transitions that the run has stored.
        inserted_total: u64,
        /// Whether the replay server keeps the chunk and will store it: then a [`ChunkPoll`] is enough, else it must be sent again.
        kept: bool,
    },
    /// Not stored: chunks before it are missing; send from this sequence number on.
    OutOfOrder {
        /// The sequence number that is expected.
        expected: u64,
    },
    /// Not stored, and no longer wanted: the run has all the transitions it asked for.
    Finished {
        /// Transitions that the run has stored.
        inserted_total: u64,
    },
    /// Not stored, and never will be: the reason, for a person.
    Refused {
        /// The replay server's reason, a sentence.
        why: String,
    },
}
