//! Brings chunks to the replay server, each exactly once and in order, and says when the actor leaves.
//! It does not drop: a chunk leaves the line when the replay server says that it is stored or no longer wanted.

mod worker;

use std::{
    sync::{
        Arc, Condvar, Mutex, MutexGuard, PoisonError,
        atomic::{AtomicBool, AtomicU32, AtomicU64, Ordering},
        mpsc,
    },
    thread::JoinHandle,
    time::Duration,
};

use driml_protocol::{BufferPool, Chunk, RunClient, Shutdown, session::SessionError};

use crate::config::Config;
use worker::DeliveryWorker;

/// How long an actor whose chunks wait may wait for newer weights.
const FRESH_WEIGHTS_MAX: Duration = Duration::from_millis(200);

/// A thread that delivers, and the queue to it.
pub struct Delivery {
    queue: mpsc::Sender<Chunk>,
    limit: usize,
    state: Arc<DeliveryState>,
    thread: JoinHandle<Result<u64, DeliveryError>>,
}

impl Delivery {
    /// Starts the thread. `inserted_total` is the run's count so far; `pool` is where the chunks' memory comes from. The actor
    /// has joined the run with the incarnation of its chunks.
    pub fn start(
        client: RunClient,
        inserted_total: u64,
        limits: DeliveryLimits,
        pool: BufferPool,
        shutdown: Shutdown,
    ) -> std::io::Result<Self> {
        let state = Arc::new(DeliveryState::default());
        state
            .inserted_total
            .store(inserted_total, Ordering::Relaxed);
        // Until a chunk was let in at once: many actors that start together must not run ahead of the learner together.
        state.is_held.store(true, Ordering::Relaxed);
        let (queue, chunks) = mpsc::channel();
        let worker = DeliveryWorker::new(client, limits, pool, shutdown, state.clone());
        let thread = std::thread::Builder::new()
            .name("delivery".into())
            .spawn(move || worker.run(&chunks))?;
        Ok(Self {
            queue,
            limit: limits.chunks_in_flight_max,
            state,
            thread,
        })
    }

    /// Transitions that the run has stored, as of the last answer.
    pub fn inserted_total(&self) -> u64 {
        self.state.inserted_total.load(Ordering::Relaxed)
    }

    /// Actors that are connected to the run, as of the last answer; 0 before the first.
    pub fn actors(&self) -> u32 {
        self.state.actors.load(Ordering::Relaxed)
    }

    /// How long the actor has time to wait for newer weights before it begins its next chunk: where the rate limiter makes its
    /// chunks wait, it loses nothing by acting with the newest.
    pub fn fresh_weights_max(&self) -> Duration {
        match self.state.is_held() {
            true => FRESH_WEIGHTS_MAX,
            false => Duration::ZERO,
        }
    }

    /// The run has all the transitions it wants.
    pub fn is_finished(&self) -> bool {
        self.state.finished.load(Ordering::Relaxed)
    }

    /// What the next chunk would wait for now; none if it would not.
    pub fn describe_wait(&self) -> Option<&'static str> {
        let waiting = *self.state.waiting();
        match self.state.is_held() {
            true if waiting >= 1 => Some("waits until the rate limiter lets its chunk in"),
            false if waiting >= self.limit => Some("waits for the replay server's answer"),
            _ => None,
        }
    }

    /// Queues a chunk, waiting while too many are not acknowledged: one, where the rate limiter makes chunks wait. `false`: the
    /// thread has ended; [`Self::finish`] says why.
    pub fn send(&self, chunk: Chunk) -> bool {
        let mut waiting = self.state.waiting();
        loop {
            let limit = if self.state.is_held() { 1 } else { self.limit };
            if *waiting < limit || self.thread.is_finished() {
                break;
            }
            // The time-out is for a thread that ended without a word.
            (waiting, _) = self
                .state
                .settled
                .wait_timeout(waiting, Duration::from_secs(1))
                .unwrap_or_else(PoisonError::into_inner);
        }
        *waiting += 1;
        self.queue.send(chunk).is_ok()
    }

    /// Waits for the last chunk and sends `Leave`; gives the number of transitions that were not wanted any more.
    pub fn finish(self) -> Result<u64, DeliveryError> {
        drop(self.queue);
        let panicked = |_| DeliveryError::Failed("the delivery thread panicked".into());
        self.thread.join().map_err(panicked)?
    }
}

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
struct DeliveryState {
    inserted_total: AtomicU64,
    actors: AtomicU32,
    finished: AtomicBool,
    /// The rate limiter makes chunks wait: more than one at a time would only grow old.
    is_held: AtomicBool,
    /// Chunks that were sent and are not yet settled.
    waiting: Mutex<usize>,
    settled: Condvar,
}

impl DeliveryState {
    fn waiting(&self) -> MutexGuard<'_, usize> {
        self.waiting.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn settle(&self) {
        *self.waiting() -= 1;
        self.settled.notify_all();
    }

    fn is_held(&self) -> bool {
        self.is_held.load(Ordering::Relaxed)
    }
}

/// Why chunks could not be delivered.
#[derive(Debug, thiserror::Error)]
pub enum DeliveryError {
    /// No answer for too long.
    #[error("the replay server was out of reach for {within:?}")]
    OutOfReach {
        /// How long it was tried.
        within: Duration,
        /// The last try's error.
        source: SessionError,
    },
    /// Anything else: a chunk was refused, or not stored in the time that an actor has which was told to stop.
    #[error("{0}")]
    Failed(String),
}
