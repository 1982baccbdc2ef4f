//! Delivers chunks to the replay server, each exactly once and in order, and then tells it that the actor leaves.
//! Unless delivery fails, a chunk stays queued until the replay server replies that it is stored or no longer wanted.

mod state;
mod worker;

use std::{
    sync::{Arc, PoisonError, mpsc},
    thread::JoinHandle,
    time::Duration,
};

use driml_protocol::{ActorJoin, BufferPool, Chunk, RunClient, Shutdown, lock, spawn};

use state::{DeliveryState, Progress};
use worker::DeliveryWorker;

pub use state::DeliveryLimits;

/// How long an actor may wait for newer weights while the rate limiter holds its chunks.
const FRESH_WEIGHTS_WAIT_MAX: Duration = Duration::from_millis(200);

/// The delivery thread, and the queue of chunks to it.
pub struct Delivery {
    queue: mpsc::Sender<Chunk>,
    chunks_max: usize,
    state: Arc<DeliveryState>,
    thread: JoinHandle<anyhow::Result<u64>>,
}

impl Delivery {
    /// Starts the thread. `inserted_total` is the number of transitions that the run has stored so far; the chunks'
    /// memory comes from `pool`. The actor must have joined the run, and its chunks carry its number and incarnation.
    pub fn start(
        client: RunClient,
        actor: ActorJoin,
        inserted_total: u64,
        limits: DeliveryLimits,
        pool: BufferPool,
        shutdown: Shutdown,
    ) -> std::io::Result<Self> {
        let state = Arc::new(DeliveryState::default());
        lock(&state.progress).inserted_total = inserted_total;
        // Held until a first chunk is stored at once: actors that start together must not run ahead of the learner together.
        lock(&state.progress).is_held = true;
        let (queue, chunks) = mpsc::channel();
        let worker = DeliveryWorker::new(client, actor, limits, pool, shutdown, state.clone());
        let thread = spawn("delivery", move || worker.run(&chunks))?;
        Ok(Self {
            queue,
            chunks_max: limits.chunks_in_flight_max,
            state,
            thread,
        })
    }

    pub(crate) fn progress(&self) -> Progress {
        *lock(&self.state.progress)
    }

    /// How long the actor may wait for newer weights before its next chunk: while the rate limiter holds its chunks, waiting is free.
    pub fn fresh_weights_wait_max(&self) -> Duration {
        match self.progress().is_held {
            true => FRESH_WEIGHTS_WAIT_MAX,
            false => Duration::ZERO,
        }
    }

    /// Describes what the next chunk would wait for now; `None` if it would not wait.
    pub fn describe_wait(&self) -> Option<&'static str> {
        let progress = self.progress();
        let in_flight = progress.in_flight;
        match progress.is_held {
            true if in_flight >= 1 => Some("waits until the rate limiter accepts its chunk"),
            false if in_flight >= self.chunks_max => Some("waits for the replay server's answer"),
            _ => None,
        }
    }

    /// Queues a chunk, waiting while `chunks_in_flight_max` chunks are not settled, or one if the rate limiter holds
    /// chunks. Returns `false` if the thread has ended; [`Self::finish`] then returns why.
    pub fn send(&self, chunk: Chunk) -> bool {
        let mut progress = lock(&self.state.progress);
        loop {
            let limit = if progress.is_held { 1 } else { self.chunks_max };
            if progress.in_flight < limit || self.thread.is_finished() {
                break;
            }
            // The time-out is for a thread that ended without a notification.
            let settled = &self.state.settled;
            let waited = settled.wait_timeout(progress, Duration::from_secs(1));
            (progress, _) = waited.unwrap_or_else(PoisonError::into_inner);
        }
        progress.in_flight += 1;
        self.queue.send(chunk).is_ok()
    }

    /// Waits until the last chunk is settled, and then sends `Leave`, unless the actor `has_failed` with all chunks delivered. Returns the
    /// number of transitions that the run no longer wanted.
    ///
    /// # Errors
    /// The replay server was unreachable for too long, rejected a chunk, or did not store it in time after a shutdown.
    pub fn finish(self, has_failed: bool) -> anyhow::Result<u64> {
        lock(&self.state.progress).has_failed = has_failed;
        drop(self.queue);
        let panicked = |_| anyhow::anyhow!("the delivery thread panicked");
        self.thread.join().map_err(panicked)?
    }
}
