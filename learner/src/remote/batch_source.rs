//! Fetches batches ahead of the update that needs them, several requests in flight, one thread each.
//! It neither reorders nor keeps batches: the learner learns first from what arrives first.

use std::{
    sync::{Arc, mpsc},
    thread::JoinHandle,
    time::{Duration, Instant},
};

use anyhow::bail;
use driml_protocol::{RunClient, Shutdown, join_within, spawn};

pub use super::fetcher::{Counters, NextBatch, Requests, ServedBatch};
use super::fetcher::{Fetched, Fetcher, SharedState};

/// How long the threads may take to end.
const JOIN_TIMEOUT: Duration = Duration::from_secs(2);

/// The queue of fetched batches.
pub struct BatchSource {
    fetched: mpsc::Receiver<Fetched>,
    /// Number of threads that have not reported that they are finished.
    running_threads: u32,
    threads: Vec<JoinHandle<()>>,
    shared: Arc<SharedState>,
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
        let shared = SharedState::new(clients, requests, counters, shutdown);
        let mut threads = Vec::new();
        for i in 0..requests.in_flight {
            let fetcher = Fetcher::new(&shared);
            let sender = sender.clone();
            let fetch = move || fetcher.run(&sender);
            threads.push(spawn(format!("batches-{i}"), fetch)?);
        }
        Ok(Self {
            fetched,
            running_threads: requests.in_flight,
            threads,
            shared,
        })
    }

    /// Waits until the threads have ended, which the end of the session causes.
    pub fn join_threads(self) {
        drop(self.fetched);
        join_within(self.threads, JOIN_TIMEOUT);
    }

    /// Returns the next batch. Batches in flight when the first thread learns that the run is over still arrive.
    ///
    /// # Errors
    /// The replay server was unreachable for too long, or rejects a request.
    pub fn next(&mut self, timeout: Duration) -> anyhow::Result<NextBatch> {
        let deadline = Instant::now() + timeout;
        while self.running_threads > 0 {
            let left = deadline.saturating_duration_since(Instant::now());
            match self.fetched.recv_timeout(left) {
                Ok(Ok(NextBatch::Finished)) => self.running_threads -= 1,
                Ok(fetched) => return fetched,
                Err(mpsc::RecvTimeoutError::Disconnected) if !self.shared.shutdown.is_set() => {
                    bail!("the threads that fetch batches have ended");
                }
                Err(_) => return Ok(NextBatch::NotYet(self.shared.waiting())),
            }
        }
        Ok(NextBatch::Finished)
    }
}
