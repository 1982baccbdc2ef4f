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

pub(crate) struct SyntheticActor {
    delivery: Delivery,
    next: ChunkHeader,
}

impl SyntheticActor {
    /// Starts an actor whose chunks all look like `first`.
    pub(crate) fn start(
        run: RunClient,
        first: ChunkHeader,
        limits: DeliveryLimits,
        stop: &Shutdown,
    ) -> Self {
        let actor = ActorJoin::new(first.actor, first.incarnation);
        let delivery = Delivery::start(run, actor, 0, limits, BufferPool::new(8), stop.clone());
        Self {
            delivery: delivery.unwrap(),
            next: first,
        }
    }

    /// Sends the next chunk. `number` is the number of the very first transition of the actor.
    pub(crate) fn send(&mut self, number: u64) {
        let mut chunk = Chunk::zeroed(self.next);
        for row in 0..self.next.transitions() {
            let number = number + self.next.first_transition + row as u64;
            chunk.set(row, 0, number as f32, End::Terminal);
        }
        self.next.sequence += 1;
        self.next.first_transition += self.next.transitions() as u64;
        assert!(self.delivery.send(chunk));
    }

    /// Delivers the remaining chunks, and returns the number of transitions sent.
    pub(crate) fn finish(self) -> u64 {
        assert_eq!(self.delivery.finish(false).unwrap(), 0);
        self.next.first_transition
    }
}
