//! An actor without a world: it sends numbered transitions through the real delivery; each is an episode whose return is its number. A
//! learner without a network fetches batches as the real one does. The tests that start them check the results.

use std::time::Duration;

use driml_actor::{Delivery, DeliveryLimits};
use driml_learner::remote::batch_source::{
    BatchSource, Counters, NextBatch, Requests, ServedBatch,
};
use driml_protocol::{ActorJoin, BufferPool, Chunk, ChunkHeader, End, RunClient, Shutdown};

/// The time-out of a batch and of a reply.
const TIMEOUT: Duration = Duration::from_secs(60);

pub(crate) struct SyntheticLearner {
    source: BatchSource,
}

impl SyntheticLearner {
    /// Starts a learner that requests batches of `rows` rows from these replay servers, one per shard, `in_flight` at a time.
    pub(crate) fn start(clients: &[RunClient], learner: u64, rows: u32, in_flight: u32) -> Self {
        let requests = Requests {
            learner_id: learner,
            rows,
            in_flight,
            shared_memory: false,
            unreachable_max: TIMEOUT,
        };
        let (counters, never) = (Counters::at_start(clients.len()), Shutdown::default());
        let source = BatchSource::start(clients, requests, &counters, &never).unwrap();
        Self { source }
    }

    /// Returns the next batch; `None` at the end of the run.
    pub(crate) fn next(&mut self) -> Option<ServedBatch> {
        match self.source.next(TIMEOUT).unwrap() {
            NextBatch::Ready(served) => Some(*served),
            NextBatch::Finished => None,
            NextBatch::NotYet(waiting) => panic!("no batch in a minute: {waiting}"),
        }
    }

    pub(crate) fn end(self) {
        self.source.join_threads();
    }
}

/// Delivers `chunks` chunks of an actor, which all look like `first`. If `leaving`, the actor is told to stop before it sends the first.
///
/// The transitions of actor 0 have the numbers from 0, those of the next actor continue, and so on.
pub(crate) fn deliver_numbered(
    run: RunClient,
    first: ChunkHeader,
    chunks: u64,
    limits: DeliveryLimits,
    leaving: bool,
) {
    let actor = ActorJoin::new(first.actor, first.incarnation);
    let stop = Shutdown::default();
    let delivery = Delivery::start(run, actor, 0, limits, BufferPool::new(8), stop.clone());
    let delivery = delivery.unwrap();
    if leaving {
        stop.set();
    }
    let length = first.transitions() as u64;
    for sequence in 0..chunks {
        let mut chunk = Chunk::zeroed(ChunkHeader {
            sequence,
            first_transition: sequence * length,
            ..first
        });
        let number = (u64::from(first.actor) * chunks + sequence) * length;
        for row in 0..length {
            chunk.set(row as usize, 0, (number + row) as f32, End::Terminal);
        }
        assert!(delivery.send(chunk));
    }
    assert_eq!(delivery.finish(false).unwrap(), 0);
}
