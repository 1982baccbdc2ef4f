//! Fetches batches ahead of the update that needs them, several requests in flight, each on a thread of its own.
//! It does not reorder or keep batches: what arrives first is learned from first.

use std::{
    sync::mpsc,
    thread::JoinHandle,
    time::{Duration, Instant},
};

use anyhow::{Context, bail};
use driml_protocol::{
    Batch, BatchReply, BatchRequest, Keys, Kind, PlanesPool, Shutdown, codec,
    session::{self, SessionError},
    shutdown::join_within,
};
use zenoh::{Session, qos::Priority};

/// One request; the replay server answers within a second, if only to say that there is nothing yet.
const REQUEST_TIMEOUT: Duration = Duration::from_secs(10);
/// Pause between two tries when the replay server is out of reach.
const RETRY_PAUSE: Duration = Duration::from_millis(200);
/// How long the replay server may be out of reach before the learner gives up.
const UNREACHABLE_MAX: Duration = Duration::from_secs(60);

/// How long the threads may take to end.
const THREADS_END_MAX: Duration = Duration::from_secs(2);

/// After a batch in shared memory was lost, how many come through the socket before shared memory is tried again.
const AVOID_COUNT: u32 = 64;

/// What is asked for, and how.
#[derive(Clone, Copy, Debug)]
pub struct Requests {
    /// Rows of a batch.
    pub rows: u32,
    /// Requests on their way at once, and threads that wait for them.
    pub in_flight: u32,
    /// Whether batches may come through shared memory.
    pub shared_memory: bool,
}

/// What a fetching thread says.
enum Fetched {
    Batch(Batch),
    Finished,
    Failed(anyhow::Error),
}

/// The queue of fetched batches.
pub struct BatchSource {
    fetched: mpsc::Receiver<Fetched>,
    /// Threads that have not said that they are finished.
    fetching: u32,
    threads: Vec<JoinHandle<()>>,
}

/// What the learner gets when it asks for its next batch.
pub enum Next {
    /// One.
    Batch(Batch),
    /// None within the time given.
    NotYet,
    /// None ever again.
    Finished,
}

impl BatchSource {
    /// Starts asking.
    ///
    /// # Errors
    /// The operating system gave no thread.
    pub fn start(
        session: &Session,
        keys: &Keys,
        spec_hash: u64,
        requests: Requests,
        shutdown: &Shutdown,
    ) -> std::io::Result<Self> {
        let (sender, fetched) = mpsc::sync_channel(0);
        // A batch a thread, and the one that is learned from.
        let pool = PlanesPool::new(requests.in_flight as usize + 1);
        let mut threads = Vec::new();
        for i in 0..requests.in_flight {
            let fetcher = Fetcher {
                session: session.clone(),
                key: keys.batch(),
                spec_hash,
                requests,
                pool: pool.clone(),
                by_socket: 0,
                shutdown: shutdown.clone(),
            };
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
        })
    }

    /// Waits for the threads' end, which the end of the session brings about.
    pub fn end(self) {
        drop(self.fetched);
        join_within(self.threads, THREADS_END_MAX);
    }

    /// The next batch; batches that are on their way when the first thread hears of the end still come.
    ///
    /// # Errors
    /// The replay server was out of reach for too long, or refuses.
    pub fn next(&mut self, timeout: Duration) -> anyhow::Result<Next> {
        let deadline = Instant::now() + timeout;
        while self.fetching > 0 {
            let left = deadline.saturating_duration_since(Instant::now());
            match self.fetched.recv_timeout(left) {
                Ok(Fetched::Batch(batch)) => return Ok(Next::Batch(batch)),
                Ok(Fetched::Finished) => self.fetching -= 1,
                Ok(Fetched::Failed(e)) => return Err(e),
                Err(mpsc::RecvTimeoutError::Timeout) => return Ok(Next::NotYet),
                Err(mpsc::RecvTimeoutError::Disconnected) => break,
            }
        }
        Ok(Next::Finished)
    }
}

struct Fetcher {
    session: Session,
    key: String,
    spec_hash: u64,
    requests: Requests,
    pool: PlanesPool,
    /// Batches that are still to come through the socket.
    by_socket: u32,
    shutdown: Shutdown,
}

impl Fetcher {
    fn run(mut self, sender: &mpsc::SyncSender<Fetched>) {
        let mut answered = Instant::now();
        while !self.shutdown.is_set() {
            let fetched = match self.fetch() {
                Ok(None) => {
                    answered = Instant::now();
                    continue;
                }
                Ok(Some(fetched)) => fetched,
                Err(e) if answered.elapsed() > UNREACHABLE_MAX => Fetched::Failed(
                    e.context(format!("no batch and no answer for {UNREACHABLE_MAX:?}")),
                ),
                Err(e) => {
                    tracing::warn!("asking for a batch again: {e:#}");
                    self.shutdown.wait_timeout(RETRY_PAUSE);
                    continue;
                }
            };
            let last = !matches!(fetched, Fetched::Batch(_));
            if sender.send(fetched).is_err() || last {
                return;
            }
            answered = Instant::now();
        }
    }

    /// One request; `None` where the replay server has nothing yet.
    fn fetch(&mut self) -> anyhow::Result<Option<Fetched>> {
        let request = BatchRequest {
            rows: self.requests.rows,
            shared_memory: self.requests.shared_memory && self.by_socket == 0,
        };
        let message = codec::encode(Kind::BatchRequest, self.spec_hash, &request, &[])?;
        let answer = session::ask(
            &self.session,
            &self.key,
            message.into(),
            Priority::Data,
            REQUEST_TIMEOUT,
        )
        .inspect_err(|e| {
            if request.shared_memory && matches!(e, SessionError::NoReply { .. }) {
                self.by_socket = AVOID_COUNT;
            }
        })?;
        self.by_socket = self.by_socket.saturating_sub(1);
        let (reply, planes) = codec::receive(
            answer.slices(),
            answer.len(),
            &self.pool,
            Kind::BatchReply,
            Some(self.spec_hash),
        )
        .context("a batch")?;
        match reply {
            BatchReply::Batch(header) => {
                Ok(Some(Fetched::Batch(Batch::from_planes(header, planes)?)))
            }
            BatchReply::Wait(_) => Ok(None),
            BatchReply::Finished => Ok(Some(Fetched::Finished)),
            BatchReply::Refused { why } => bail!("the replay server refuses: {why}"),
        }
    }
}
