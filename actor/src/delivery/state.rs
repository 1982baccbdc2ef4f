//! What the sending side and the delivering thread tell each other, and the limits that both keep.
//! The chunks themselves go through a queue.

use std::{
    sync::{Condvar, Mutex, MutexGuard},
    time::Duration,
};

use driml_protocol::{lock, session::SessionError};

use crate::config::Config;

/// Limits of one delivery.
#[derive(Clone, Copy, Debug)]
pub struct DeliveryLimits {
    /// Chunks waiting to be acknowledged; at this many `send` waits.
    pub chunks_in_flight_max: usize,
    /// How long the replay server may be silent about a chunk that it was sent; a chunk that has to wait is answered meanwhile.
    pub ack_timeout: Duration,
    /// All tries for one chunk without any answer.
    pub unreachable_max: Duration,
}

impl DeliveryLimits {
    /// The limits that an actor's settings ask for.
    pub const fn of(config: &Config) -> Self {
        Self {
            chunks_in_flight_max: config.chunks_in_flight_max as usize,
            ack_timeout: Duration::from_millis(config.ack_timeout_ms),
            unreachable_max: Duration::from_millis(config.unreachable_max_ms),
        }
    }
}

/// What the sending side and the thread tell each other beside the chunks.
#[derive(Debug, Default)]
pub(super) struct DeliveryState {
    progress: Mutex<Progress>,
    /// Signalled when a chunk is settled.
    pub(super) settled: Condvar,
}

/// How far the delivery is, as of the last answer.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Progress {
    /// Transitions that the run has stored.
    pub(crate) inserted_total: u64,
    /// Actors that are connected to the run; 0 before the first answer.
    pub(crate) actors: u32,
    /// The run has all the transitions it wants.
    pub(crate) finished: bool,
    /// The rate limiter makes chunks wait: more than one at a time would only grow old.
    pub(super) is_held: bool,
    /// Chunks that were sent and are not yet settled.
    pub(super) waiting: usize,
}

impl DeliveryState {
    pub(super) fn progress(&self) -> MutexGuard<'_, Progress> {
        lock(&self.progress)
    }
}

/// Why chunks could not be delivered.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs, reason = "each message says it")]
pub enum DeliveryError {
    #[error("the replay server was out of reach for {within:?}")]
    OutOfReach {
        within: Duration,
        source: SessionError,
    },
    /// Anything else: a chunk was refused, or not stored in the time that an actor has which was told to stop.
    #[error("{0}")]
    Failed(String),
}
