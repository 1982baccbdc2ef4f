//! Fetches batches ahead of the update that needs them, several requests in flight, one thread each.
//! It neither reorders nor keeps batches: the learner learns first from what arrives first.

use std::{
    sync::{Arc, mpsc},
    thread::JoinHandle,
    time::{Duration, Instant},
};

use driml_protocol::{RunClient, Shutdown, Waiting, join_within};

pub use super::fetcher::{Counters, Requests, Served};
use super::{
    error::BatchError,
    fetcher::{Fetched, Fetcher, Shared},
};

/// How long the threads may take to end.
const THREADS_END_MAX: Duration = Duration::from_secs(2);

/// The queue of fetched batches.
pub struct BatchSource {
    fetched: mpsc::Receiver<Fetched>,
    /// Number of threads that have not reported that they are finished.
    fetching: u32,
    threads: Vec<JoinHandle<()>>,
    shared: Arc<Shared>,
}

/// The result of waiting for the next batch.
pub enum Next {
    /// A batch to learn from.
    Batch(Box<Served>),
    /// No batch arrived within the time-out; call again. The replay server reports which side waits for the other.
    NotYet(Waiting),
    /// The run is over: no further batch will come.
    Finished,
}

impl BatchSource {
    /// Starts the threads that request batches.
    pub fn start(
        clients: &[RunClient],
        requests: Requests,
        counters: &Arc<Counters>,
        shutdown: &Shutdown,
    ) -> std::io::Result<Self> {
        let (sender, fetched) = mpsc::sync_channel(0);
        let shared = Shared::new(clients, requests, counters, shutdown);
        let mut threads = Vec::new();
        for i in 0..requests.in_flight {
            let fetcher = Fetcher::new(&shared);
            let sender = sender.clone();
            let thread = std::thread::Builder::new()
                .name(format!("batches-{i}"))
                .spawn(move || fetcher.run(&sender))?;
            threads.push(thread);
        }
        Ok(Self {
            fetched,
            fetching: requests.in_flight,
            threads,
            shared,
        })
    }

    /// Waits until the threads have ended, which the end of the session causes.
    pub fn end(self) {
        drop(self.fetched);
        join_within(self.threads, THREADS_END_MAX);
    }

    /// Returns the next batch. Batches in flight when the first thread learns that the run is over still arrive.
    ///
    /// # Errors
    /// The replay server was unreachable for too long, or rejects a request.
    pub fn next(&mut self, timeout: Duration) -> Result<Next, BatchError> {
        let deadline = Instant::now() + timeout;
        while self.fetching > 0 {
            let left = deadline.saturating_duration_since(Instant::now());
            match self.fetched.recv_timeout(left) {
                Ok(Fetched::Batch(served)) => return Ok(Next::Batch(served)),
                Ok(Fetched::Finished) => self.fetching -= 1,
                Ok(Fetched::Failed(e)) => return Err(e),
                Err(mpsc::RecvTimeoutError::Disconnected) if !self.shared.shutdown.is_set() => {
                    return Err(BatchError::ThreadsEnded);
                }
                Err(_) => return Ok(Next::NotYet(self.shared.waiting())),
            }
        }
        Ok(Next::Finished)
    }
}
