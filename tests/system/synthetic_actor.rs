//! An actor without a world: numbered transitions through the real delivery, each an episode of its own whose return is its number.
//! What becomes of them is for the tests that start one.

use driml_actor::{Delivery, DeliveryLimits};
use driml_protocol::{BufferPool, Chunk, ChunkHeader, End, RunClient, Shutdown};

pub(crate) struct SyntheticActor {
    delivery: Delivery,
    next: ChunkHeader,
}

impl SyntheticActor {
    /// One whose chunks all look like `first`.
    pub(crate) fn start(
        run: RunClient,
        first: ChunkHeader,
        limits: DeliveryLimits,
        stop: &Shutdown,
    ) -> Self {
        let delivery = Delivery::start(run, 0, limits, BufferPool::new(8), stop.clone());
        Self {
            delivery: delivery.unwrap(),
            next: first,
        }
    }

    /// Sends the next chunk; `number` is that of the actor's first transition of all.
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

    /// Delivers what it has, and gives the number of its transitions.
    pub(crate) fn finish(self) -> u64 {
        assert_eq!(self.delivery.finish().unwrap(), 0);
        self.next.first_transition
    }
}
