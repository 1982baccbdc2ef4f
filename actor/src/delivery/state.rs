//! The state that the acting thread and the delivery thread share, and the limits that both keep.
//! The chunks themselves go through a queue.

use std::{
    sync::{Condvar, Mutex},
    time::Duration,
};

use crate::config::Config;

/// Limits of one delivery.
#[derive(Clone, Copy, Debug)]
pub struct DeliveryLimits {
    /// The most chunks that are not settled; at this many `send` waits.
    pub chunks_in_flight_max: usize,
    /// Time-out of the reply to a chunk. The replay server also replies in this time while the rate limiter holds the chunk.
    pub ack_timeout: Duration,
    /// How long delivery may go without any reply, over all tries, before it fails.
    pub unreachable_max: Duration,
}

impl DeliveryLimits {
    /// Takes the limits from an actor's settings.
    pub const fn from_config(config: &Config) -> Self {
        Self {
            chunks_in_flight_max: config.chunks_in_flight_max as usize,
            ack_timeout: Duration::from_millis(config.ack_timeout_ms),
            unreachable_max: Duration::from_millis(config.unreachable_max_ms),
        }
    }
}

/// The state that the acting thread and the delivery thread share, besides the queue.
#[derive(Debug, Default)]
pub(super) struct DeliveryState {
    pub(super) progress: Mutex<Progress>,
    /// Notified when a chunk is settled: stored, no longer wanted, or given up after a failure.
    pub(super) settled: Condvar,
}

/// The progress of the delivery, as of the last reply.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Progress {
    /// Transitions that the run has stored.
    pub(crate) inserted_total: u64,
    /// Actors that are connected to the run; 0 before the first answer.
    pub(crate) actors: u32,
    /// Whether the run has all the transitions that it wants, or delivery has failed.
    pub(crate) is_finished: bool,
    /// Whether the rate limiter holds chunks: the actor then queues one at a time, as others would only grow old.
    pub(super) is_held: bool,
    /// Whether the actor has failed: with all chunks delivered it then sends no `Leave`, so that it counts as missing.
    pub(super) has_failed: bool,
    /// Chunks that were queued and are not yet settled.
    pub(super) in_flight: usize,
}
