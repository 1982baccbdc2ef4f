//! Fetches batches ahead of the update that needs them, several requests in flight, each on a thread of its own.
//! It does not reorder or keep batches: what arrives first is learned from first.

use std::{
    sync::mpsc,
    time::{Duration, Instant},
};

use anyhow::{Context, bail};
use driml_protocol::{Batch, BatchReply, BatchRequest, Keys, Kind, Shutdown, codec, session};
use zenoh::{Session, qos::Priority};

/// One request; the replay server answers within a second, if only to say that there is nothing yet.
const REQUEST_TIMEOUT: Duration = Duration::from_secs(10);
/// Pause between two tries when the replay server is out of reach.
const RETRY_PAUSE: Duration = Duration::from_millis(200);
/// How long the replay server may be out of reach before the learner gives up.
const UNREACHABLE_MAX: Duration = Duration::from_secs(60);

/// What a fetching thread says.
enum Fetched {
    Batch(Batch),
    Finished,
    Failed(anyhow::Error),
}

/// The queue of fetched batches.
pub struct BatchSource {
    fetched: mpsc::Receiver<Fetched>,
    threads: u32,
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
    /// Starts `threads` requests in a row, for batches of `rows` rows of the run with this hash.
    ///
    /// # Errors
    /// The operating system gave no thread.
    pub fn start(
        session: &Session,
        keys: &Keys,
        spec_hash: u64,
        rows: u32,
        threads: u32,
        shutdown: &Shutdown,
    ) -> std::io::Result<Self> {
        let (sender, fetched) = mpsc::sync_channel(0);
        for i in 0..threads {
            let fetcher = Fetcher {
                session: session.clone(),
                key: keys.batch(),
                spec_hash,
                rows,
                shutdown: shutdown.clone(),
            };
            let sender = sender.clone();
            std::thread::Builder::new()
                .name(format!("batches-{i}"))
                .spawn(move || fetcher.run(&sender))?;
        }
        Ok(Self { fetched, threads })
    }

    /// The next batch; batches that are on their way when the first thread hears of the end still come.
    ///
    /// # Errors
    /// The replay server refused, or was out of reach for too long.
    pub fn next(&mut self, timeout: Duration) -> anyhow::Result<Next> {
        let deadline = Instant::now() + timeout;
        while self.threads > 0 {
            let left = deadline.saturating_duration_since(Instant::now());
            match self.fetched.recv_timeout(left) {
                Ok(Fetched::Batch(batch)) => return Ok(Next::Batch(batch)),
                Ok(Fetched::Finished) => self.threads -= 1,
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
    rows: u32,
    shutdown: Shutdown,
}

impl Fetcher {
    fn run(self, sender: &mpsc::SyncSender<Fetched>) {
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
    fn fetch(&self) -> anyhow::Result<Option<Fetched>> {
        let request = BatchRequest { rows: self.rows };
        let request = codec::encode(Kind::BatchRequest, self.spec_hash, &request, &[])?;
        let bytes = session::ask(
            &self.session,
            &self.key,
            request.into(),
            Priority::Data,
            REQUEST_TIMEOUT,
        )?;
        let (reply, planes) =
            codec::decode(&bytes, Kind::BatchReply, Some(self.spec_hash)).context("a batch")?;
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
