//! Brings chunks to the replay server, each exactly once and in order, and says goodbye.
//! It does not drop: a chunk leaves the line when the replay server says that it is stored or no longer wanted.

use std::{
    collections::VecDeque,
    sync::{
        Arc, Condvar, Mutex, MutexGuard, PoisonError,
        atomic::{AtomicBool, AtomicU64, Ordering},
        mpsc,
    },
    thread::JoinHandle,
    time::{Duration, Instant},
};

use anyhow::{Context, bail};
use driml_protocol::{
    Chunk, ChunkHeader, Goodbye, InsertReply, Keys, Kind, PlanesPool, Shutdown, codec,
    session::{self, Asked, SessionError},
};
use zenoh::{Session, bytes::ZBytes, qos::Priority};

use crate::config::Config;

/// After `Shutdown`, how long the chunks at hand may take to be stored.
const DRAIN_MAX: Duration = Duration::from_secs(20);
/// Pause between two tries when the replay server is out of reach.
const RETRY_PAUSE: Duration = Duration::from_millis(200);

/// Limits of one delivery.
#[derive(Clone, Copy, Debug)]
pub struct DeliveryLimits {
    /// Chunks waiting to be acknowledged; at this many `send` waits.
    pub chunks_in_flight_max: usize,
    /// One try.
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
struct Account {
    inserted_total: AtomicU64,
    finished: AtomicBool,
    /// Chunks that were sent and are not yet settled.
    waiting: Mutex<usize>,
    settled: Condvar,
}

impl Account {
    fn waiting(&self) -> MutexGuard<'_, usize> {
        self.waiting.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn settle(&self) {
        *self.waiting() -= 1;
        self.settled.notify_all();
    }
}

/// A thread that delivers, and the queue to it.
pub struct Delivery {
    queue: mpsc::Sender<Chunk>,
    limit: usize,
    account: Arc<Account>,
    thread: JoinHandle<anyhow::Result<u64>>,
}

impl Delivery {
    /// Starts the thread. `inserted_total` is the run's count so far; `pool` is where the chunks' memory comes from.
    ///
    /// # Errors
    /// The operating system gave no thread.
    pub fn start(
        session: Session,
        keys: Keys,
        spec_hash: u64,
        inserted_total: u64,
        limits: DeliveryLimits,
        pool: PlanesPool,
        shutdown: Shutdown,
    ) -> std::io::Result<Self> {
        let account = Arc::new(Account::default());
        account
            .inserted_total
            .store(inserted_total, Ordering::Relaxed);
        let (queue, chunks) = mpsc::channel();
        let courier = Courier {
            session,
            keys,
            spec_hash,
            limits,
            pool,
            shutdown,
            account: account.clone(),
            outgoing: VecDeque::new(),
            window: 1,
            answered: Instant::now(),
            draining_since: None,
        };
        let thread = std::thread::Builder::new()
            .name("delivery".into())
            .spawn(move || courier.run(&chunks))?;
        Ok(Self {
            queue,
            limit: limits.chunks_in_flight_max,
            account,
            thread,
        })
    }

    /// Transitions that the run has stored, as of the last answer.
    pub fn inserted_total(&self) -> u64 {
        self.account.inserted_total.load(Ordering::Relaxed)
    }

    /// The run has all the transitions it wants.
    pub fn is_finished(&self) -> bool {
        self.account.finished.load(Ordering::Relaxed)
    }

    /// Queues a chunk, waiting while too many are not acknowledged. `false`: the thread has ended; [`Self::finish`] says
    /// why.
    pub fn send(&self, chunk: Chunk) -> bool {
        let mut waiting = self.account.waiting();
        while *waiting >= self.limit && !self.thread.is_finished() {
            // The time-out is for a thread that ended without a word.
            (waiting, _) = self
                .account
                .settled
                .wait_timeout(waiting, Duration::from_secs(1))
                .unwrap_or_else(PoisonError::into_inner);
        }
        *waiting += 1;
        self.queue.send(chunk).is_ok()
    }

    /// Waits for the last chunk and says goodbye; gives the number of transitions that were not wanted any more.
    ///
    /// # Errors
    /// A chunk that could not be delivered.
    pub fn finish(self) -> anyhow::Result<u64> {
        drop(self.queue);
        self.thread
            .join()
            .map_err(|_| anyhow::anyhow!("the delivery thread panicked"))?
    }
}

/// A chunk that is not settled yet.
struct Outgoing {
    header: ChunkHeader,
    planes: ZBytes,
    in_shared_memory: bool,
    /// Set while it is on its way.
    asked: Option<Asked>,
}

/// What became of the first chunk in line.
enum Fate {
    Stored,
    /// The run has enough transitions.
    Unwanted,
    /// It, and all after it, go out again.
    Again,
}

/// The delivering thread. Several chunks are on their way at once; they are settled in order, and where one has to go again
/// those after it, which the replay server then refused as out of order, go again too.
struct Courier {
    session: Session,
    keys: Keys,
    spec_hash: u64,
    limits: DeliveryLimits,
    pool: PlanesPool,
    shutdown: Shutdown,
    account: Arc<Account>,
    outgoing: VecDeque<Outgoing>,
    /// Chunks that may be on their way: one after a chunk had to go again, and one more with each that is stored.
    window: usize,
    /// When the replay server last answered.
    answered: Instant,
    draining_since: Option<Instant>,
}

impl Courier {
    fn run(mut self, chunks: &mpsc::Receiver<Chunk>) -> anyhow::Result<u64> {
        let mut last = None;
        let mut produced = 0;
        let mut unwanted = 0;
        let mut outcome = Ok(());
        while let Some(header) = self.first_in_line(chunks) {
            let transitions = header.transitions() as u64;
            // After a failure the rest is only counted, so that the goodbye tells the truth.
            let fate = match outcome {
                Ok(()) => self.settle_first(),
                Err(_) => Ok(Fate::Stored),
            };
            match fate {
                Ok(Fate::Again) => continue,
                Ok(Fate::Stored) => {}
                Ok(Fate::Unwanted) => unwanted += transitions,
                Err(e) => {
                    outcome = Err(e);
                    self.account.finished.store(true, Ordering::Relaxed);
                }
            }
            produced += transitions;
            last = Some((header.actor, header.epoch));
            self.outgoing.pop_front();
            self.account.settle();
        }
        if let Some((actor, epoch)) = last {
            self.say_goodbye(Goodbye {
                actor,
                epoch,
                produced: produced - unwanted,
            });
        }
        outcome.map(|()| unwanted)
    }

    /// Lines up what was queued and gives the first, waiting for one if there is none; `None` when no more will come.
    fn first_in_line(&mut self, chunks: &mpsc::Receiver<Chunk>) -> Option<ChunkHeader> {
        while self.outgoing.len() < self.limits.chunks_in_flight_max {
            let next = match self.outgoing.is_empty() {
                true => chunks.recv().ok(),
                false => chunks.try_recv().ok(),
            };
            let Some(chunk) = next else { break };
            let header = chunk.header;
            let planes = chunk.into_planes();
            self.outgoing.push_back(Outgoing {
                header,
                in_shared_memory: planes.are_shared(),
                planes: planes.freeze(),
                asked: None,
            });
        }
        self.outgoing.front().map(|first| first.header)
    }

    /// Sends what the window allows and waits for what becomes of the first.
    fn settle_first(&mut self) -> anyhow::Result<Fate> {
        let sequence = self.outgoing[0].header.sequence;
        if self.shutdown.is_set() {
            let since = *self.draining_since.get_or_insert_with(Instant::now);
            if since.elapsed() > DRAIN_MAX {
                bail!("chunk {sequence} was not stored within {DRAIN_MAX:?} of the end");
            }
        }
        let answer = self
            .send_window()
            .and_then(|()| match self.outgoing[0].asked.take() {
                Some(asked) => asked.answer(),
                None => unreachable!("the window has room for one"),
            });
        let reply =
            answer.and_then(|answer| self.read(&self.keys.ingest(), Kind::InsertReply, &answer));
        if reply.is_ok() {
            self.answered = Instant::now();
        }
        match reply {
            Ok(InsertReply::Stored { inserted_total }) => {
                self.hear(inserted_total);
                self.window = (self.window + 1).min(self.limits.chunks_in_flight_max);
                Ok(Fate::Stored)
            }
            Ok(InsertReply::Finished { inserted_total }) => {
                self.hear(inserted_total);
                self.account.finished.store(true, Ordering::Relaxed);
                Ok(Fate::Unwanted)
            }
            Ok(InsertReply::Wait { inserted_total }) => {
                self.hear(inserted_total);
                Ok(self.again())
            }
            // All before it are stored, so a gap cannot be filled: the replay server forgot this epoch.
            Ok(InsertReply::OutOfOrder { expected }) => bail!(
                "the replay server expects chunk {expected}, this actor is at {sequence}: it was restarted; start the actor again"
            ),
            Ok(InsertReply::Refused { why }) => bail!("the replay server refused a chunk: {why}"),
            Err(e) if self.answered.elapsed() > self.limits.unreachable_max => {
                Err(e).context(format!(
                    "the replay server was out of reach for {:?}",
                    self.limits.unreachable_max
                ))
            }
            Err(e) => {
                tracing::warn!("chunk {sequence} will be sent again: {e}");
                if matches!(e, SessionError::NoReply { .. }) {
                    self.leave_shared_memory();
                }
                std::thread::sleep(RETRY_PAUSE);
                Ok(self.again())
            }
        }
    }

    fn hear(&self, inserted_total: u64) {
        self.account
            .inserted_total
            .store(inserted_total, Ordering::Relaxed);
    }

    fn again(&mut self) -> Fate {
        self.window = 1;
        self.outgoing.iter_mut().for_each(|it| it.asked = None);
        Fate::Again
    }

    /// The replay server may be unable to read shared memory: what is at hand, and the next chunks, go through the socket.
    fn leave_shared_memory(&mut self) {
        for it in self.outgoing.iter_mut().filter(|it| it.in_shared_memory) {
            it.planes = ZBytes::from(it.planes.to_bytes().into_owned());
            it.in_shared_memory = false;
            self.pool.avoid_shared_memory();
        }
    }

    fn send_window(&mut self) -> Result<(), SessionError> {
        let (key, leaving) = (self.keys.ingest(), self.shutdown.is_set());
        for it in self.outgoing.iter_mut().take(self.window) {
            if it.asked.is_some() {
                continue;
            }
            it.header.leaving |= leaving;
            let head = codec::seal(
                Kind::Chunk,
                self.spec_hash,
                &it.header,
                &it.planes.to_bytes(),
            )
            .map_err(|e| SessionError::Zenoh {
                key: key.clone(),
                why: e.to_string(),
            })?;
            let message = session::join_planes(head, it.planes.clone());
            let timeout = self.limits.ack_timeout;
            it.asked = Some(session::send(
                &self.session,
                &key,
                message,
                Priority::Data,
                timeout,
            )?);
        }
        Ok(())
    }

    fn say_goodbye(&self, goodbye: Goodbye) {
        let said = codec::encode(Kind::Goodbye, self.spec_hash, &goodbye, &[])
            .context("encoding the goodbye")
            .and_then(|bytes| {
                let (key, timeout) = (self.keys.goodbye(), self.limits.ack_timeout);
                let answer =
                    session::ask(&self.session, &key, bytes.into(), Priority::Data, timeout)?;
                Ok(self.read::<()>(&key, Kind::Done, &answer)?)
            });
        if let Err(e) = said {
            tracing::warn!("the replay server did not hear the goodbye: {e:#}");
        }
    }

    fn read<H: serde::de::DeserializeOwned>(
        &self,
        key: &str,
        kind: Kind,
        answer: &ZBytes,
    ) -> Result<H, SessionError> {
        let bytes = answer.to_bytes();
        codec::decode(&bytes, kind, Some(self.spec_hash))
            .map(|(header, _)| header)
            .map_err(|e| SessionError::Zenoh {
                key: key.into(),
                why: e.to_string(),
            })
    }
}
