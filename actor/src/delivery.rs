//! Brings chunks to the replay server, each exactly once and in order, and says goodbye.
//! It does not drop: a chunk leaves the queue when the replay server says that it is stored or no longer wanted.

use std::{
    sync::{
        Arc,
        atomic::{AtomicBool, AtomicU64, Ordering},
        mpsc,
    },
    thread::JoinHandle,
    time::{Duration, Instant},
};

use anyhow::{Context, bail};
use driml_protocol::{
    Chunk, Goodbye, InsertReply, Keys, Kind, Shutdown, codec,
    session::{self, SessionError},
};
use zenoh::{Session, qos::Priority};

use crate::config::Config;

/// After `Shutdown`, how long the chunks at hand may take to be stored.
const DRAIN_MAX: Duration = Duration::from_secs(20);
/// Pause between two tries when the replay server is out of reach.
const RETRY_PAUSE: Duration = Duration::from_millis(200);

/// Limits of one delivery.
#[derive(Clone, Copy, Debug)]
pub struct DeliveryLimits {
    /// Chunks waiting; at this many `send` waits.
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

/// What the replay server said last.
#[derive(Debug, Default)]
struct Answers {
    inserted_total: AtomicU64,
    finished: AtomicBool,
}

/// A thread that delivers, and the queue to it.
pub struct Delivery {
    queue: mpsc::SyncSender<Chunk>,
    answers: Arc<Answers>,
    thread: JoinHandle<anyhow::Result<u64>>,
}

impl Delivery {
    /// Starts the thread. `inserted_total` is the run's count so far.
    ///
    /// # Errors
    /// The operating system gave no thread.
    pub fn start(
        session: Session,
        keys: Keys,
        spec_hash: u64,
        inserted_total: u64,
        limits: DeliveryLimits,
        shutdown: Shutdown,
    ) -> std::io::Result<Self> {
        let answers = Arc::new(Answers::default());
        answers
            .inserted_total
            .store(inserted_total, Ordering::Relaxed);
        // One chunk is on its way, the others wait in the channel.
        let (queue, chunks) = mpsc::sync_channel(limits.chunks_in_flight_max.saturating_sub(1));
        let courier = Courier {
            session,
            keys,
            spec_hash,
            limits,
            shutdown,
            answers: answers.clone(),
        };
        let thread = std::thread::Builder::new()
            .name("delivery".into())
            .spawn(move || courier.run(&chunks))?;
        Ok(Self {
            queue,
            answers,
            thread,
        })
    }

    /// Transitions that the run has stored, as of the last answer.
    pub fn inserted_total(&self) -> u64 {
        self.answers.inserted_total.load(Ordering::Relaxed)
    }

    /// The run has all the transitions it wants.
    pub fn is_finished(&self) -> bool {
        self.answers.finished.load(Ordering::Relaxed)
    }

    /// Queues a chunk, waiting while the queue is full. `false`: the thread has ended; [`Self::finish`] says why.
    pub fn send(&self, chunk: Chunk) -> bool {
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

struct Courier {
    session: Session,
    keys: Keys,
    spec_hash: u64,
    limits: DeliveryLimits,
    shutdown: Shutdown,
    answers: Arc<Answers>,
}

impl Courier {
    fn run(self, chunks: &mpsc::Receiver<Chunk>) -> anyhow::Result<u64> {
        let mut last = None;
        let mut produced = 0;
        let mut unwanted = 0;
        let mut outcome = Ok(());
        for mut chunk in chunks {
            let transitions = chunk.header.transitions() as u64;
            produced += transitions;
            last = Some((chunk.header.actor, chunk.header.epoch));
            // After a failure the rest is only counted, so that the goodbye tells the truth.
            if outcome.is_ok() {
                match self.deliver(&mut chunk) {
                    Ok(true) => {}
                    Ok(false) => unwanted += transitions,
                    Err(e) => {
                        outcome = Err(e);
                        self.answers.finished.store(true, Ordering::Relaxed);
                    }
                }
            }
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

    /// Whether the chunk was stored; `false` if it is no longer wanted.
    fn deliver(&self, chunk: &mut Chunk) -> anyhow::Result<bool> {
        let mut answered = Instant::now();
        let mut draining_since = None;
        loop {
            if self.shutdown.is_set() {
                let since = *draining_since.get_or_insert_with(Instant::now);
                if since.elapsed() > DRAIN_MAX {
                    bail!(
                        "chunk {} was not stored within {DRAIN_MAX:?} of the end",
                        chunk.header.sequence
                    );
                }
                chunk.header.leaving = true;
            }
            let (head, planes) = chunk.seal(self.spec_hash)?;
            match self.ask(
                &self.keys.ingest(),
                Kind::InsertReply,
                session::join_pieces([head, planes.to_vec()]),
            ) {
                Ok(InsertReply::Stored { inserted_total }) => {
                    self.answers
                        .inserted_total
                        .store(inserted_total, Ordering::Relaxed);
                    return Ok(true);
                }
                Ok(InsertReply::Finished { inserted_total }) => {
                    self.answers
                        .inserted_total
                        .store(inserted_total, Ordering::Relaxed);
                    self.answers.finished.store(true, Ordering::Relaxed);
                    return Ok(false);
                }
                Ok(InsertReply::Wait { inserted_total }) => {
                    self.answers
                        .inserted_total
                        .store(inserted_total, Ordering::Relaxed);
                    answered = Instant::now();
                }
                // This side sends one chunk at a time, so a gap cannot be filled: the replay server forgot this epoch.
                Ok(InsertReply::OutOfOrder { expected }) => bail!(
                    "the replay server expects chunk {expected}, this actor is at {}: it was restarted; start the actor again",
                    chunk.header.sequence
                ),
                Ok(InsertReply::Refused { why }) => {
                    bail!("the replay server refused a chunk: {why}")
                }
                Err(e) if answered.elapsed() > self.limits.unreachable_max => {
                    return Err(e).context(format!(
                        "the replay server was out of reach for {:?}",
                        self.limits.unreachable_max
                    ));
                }
                Err(e) => {
                    tracing::warn!("chunk {} will be sent again: {e}", chunk.header.sequence);
                    std::thread::sleep(RETRY_PAUSE);
                }
            }
        }
    }

    fn say_goodbye(&self, goodbye: Goodbye) {
        let said = codec::encode(Kind::Goodbye, self.spec_hash, &goodbye, &[])
            .context("encoding the goodbye")
            .and_then(|bytes| {
                Ok(self.ask::<()>(&self.keys.goodbye(), Kind::Done, bytes.into())?)
            });
        if let Err(e) = said {
            tracing::warn!("the replay server did not hear the goodbye: {e:#}");
        }
    }

    fn ask<H: serde::de::DeserializeOwned>(
        &self,
        key: &str,
        kind: Kind,
        payload: zenoh::bytes::ZBytes,
    ) -> Result<H, SessionError> {
        let bytes = session::ask(
            &self.session,
            key,
            payload,
            Priority::Data,
            self.limits.ack_timeout,
        )?;
        let failed = |e: codec::CodecError| SessionError::Zenoh {
            key: key.into(),
            why: e.to_string(),
        };
        Ok(codec::decode(&bytes, kind, Some(self.spec_hash))
            .map_err(failed)?
            .0)
    }
}
