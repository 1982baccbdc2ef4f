//! Fetches batches ahead of the update that needs them, several requests in flight, one thread each.
//! It does not reorder or keep batches: what arrives first is learned from first.

use std::{
    sync::{
        Arc, Mutex, PoisonError,
        atomic::{AtomicU64, Ordering},
        mpsc,
    },
    thread::JoinHandle,
    time::{Duration, Instant},
};

use driml_protocol::{
    Batch, BatchReply, BatchRequest, BufferPool, Learned, PendingReply, ReplayStatus, RequestId,
    RunClient, Seldom, Shutdown, Tally, Waiting, fault, join_within, session::SessionError,
    shared_memory::Trust,
};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::{
    error::BatchError,
    shards::{self, Count},
};
use crate::progress::{Progress, ServedPart};

/// One request; the replay server answers within a second, if only to say that there is nothing yet.
const REQUEST_TIMEOUT: Duration = Duration::from_secs(10);
/// Pause between two tries when the replay server is out of reach.
const RETRY_PAUSE: Duration = Duration::from_millis(200);

/// Pause before shards that hold nothing are asked again.
const LOOK_AGAIN: Duration = Duration::from_millis(50);
/// How long the last batch is waited for once all transitions are in.
const LAST_BATCH_MAX: Duration = Duration::from_secs(30);
/// How long the threads may take to end.
const THREADS_END_MAX: Duration = Duration::from_secs(2);

/// What is asked for, by whom, and how.
#[derive(Clone, Copy, Debug)]
pub struct Requests {
    /// The learner that has joined the run.
    pub learner: u64,
    /// Rows of a batch.
    pub rows: u32,
    /// Requests on their way at once, and threads that wait for them.
    pub in_flight: u32,
    /// Whether batches may come through shared memory.
    pub shared_memory: bool,
    /// How long the replay server may be out of reach before the learner gives up.
    pub unreachable_max: Duration,
}

/// How far the learner is, which it tells with each request.
#[derive(Debug)]
pub struct Counters {
    /// Updates done.
    pub updates: AtomicU64,
    /// Updates in the newest checkpoint.
    pub saved_updates: AtomicU64,
    /// Rows received from each shard.
    received: Vec<AtomicU64>,
}

impl Counters {
    /// Those of a learner after so many updates, all of which are saved.
    pub fn of(updates: u64, progress: &Progress) -> Arc<Self> {
        let shards = progress.shards.iter();
        Arc::new(Self {
            updates: updates.into(),
            saved_updates: updates.into(),
            received: shards.map(|it| it.rows_sampled.into()).collect(),
        })
    }

    /// Those of a learner that has learned nothing.
    pub fn at_start(shards: usize) -> Arc<Self> {
        let mut progress = Progress::default();
        progress.spread_over(shards);
        Self::of(0, &progress)
    }

    fn learned(&self, shard: usize) -> Learned {
        Learned {
            updates: self.updates.load(Ordering::Acquire),
            saved_updates: self.saved_updates.load(Ordering::Acquire),
            rows_received: self.received[shard].load(Ordering::Acquire),
        }
    }
}

/// A batch, and where its rows are from.
pub struct Served {
    /// The batch.
    pub batch: Batch,
    /// Its rows by shard.
    pub parts: Vec<ServedPart>,
}

/// What a fetching thread says.
enum Fetched {
    Batch(Box<Served>),
    Finished,
    Failed(BatchError),
}

/// The queue of fetched batches.
pub struct BatchSource {
    fetched: mpsc::Receiver<Fetched>,
    /// Threads that have not said that they are finished.
    fetching: u32,
    threads: Vec<JoinHandle<()>>,
    /// Who waits for whom, by the last answer that was no batch.
    waiting: Arc<Mutex<Waiting>>,
    shutdown: Shutdown,
}

/// What the learner gets when it asks for its next batch.
pub enum Next {
    /// A batch to learn from.
    Batch(Box<Served>),
    /// No batch came within the time given; ask again. The replay server says who waits for whom.
    NotYet(Waiting),
    /// The run is over: no further batch will come.
    Finished,
}

impl BatchSource {
    /// Starts the threads that request batches.
    ///
    /// # Errors
    /// The operating system gave no thread.
    pub fn start(
        clients: &[RunClient],
        requests: Requests,
        counters: &Arc<Counters>,
        shutdown: &Shutdown,
    ) -> std::io::Result<Self> {
        let (sender, fetched) = mpsc::sync_channel(0);
        // A batch a thread, and the one that is learned from.
        let pool = BufferPool::new(requests.in_flight as usize + clients.len());
        let partial = Arc::new(Mutex::new(PartialBatch::new(clients.len())));
        let waiting = Arc::<Mutex<Waiting>>::default();
        let mut threads = Vec::new();
        for i in 0..requests.in_flight {
            // Which rows come from which shard follows from the order of answers, so this need not be the run's.
            let mut rng = ChaCha8Rng::from_os_rng();
            let fetcher = Fetcher {
                clients: clients.to_vec(),
                partial: partial.clone(),
                id: RequestId::first(rng.random()),
                rng,
                requests,
                counters: counters.clone(),
                pool: pool.clone(),
                trust: Trust::default(),
                said: Seldom::default(),
                waiting: waiting.clone(),
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
            waiting,
            shutdown: shutdown.clone(),
        })
    }

    /// Waits for the threads' end, which the end of the session brings about.
    pub fn end(self) {
        drop(self.fetched);
        join_within(self.threads, THREADS_END_MAX);
    }

    /// The next batch; batches in flight when the first thread learns of the end still arrive.
    ///
    /// # Errors
    /// The replay server was out of reach for too long, or refuses.
    pub fn next(&mut self, timeout: Duration) -> Result<Next, BatchError> {
        let deadline = Instant::now() + timeout;
        while self.fetching > 0 {
            let left = deadline.saturating_duration_since(Instant::now());
            match self.fetched.recv_timeout(left) {
                Ok(Fetched::Batch(served)) => return Ok(Next::Batch(served)),
                Ok(Fetched::Finished) => self.fetching -= 1,
                Ok(Fetched::Failed(e)) => return Err(e),
                Err(mpsc::RecvTimeoutError::Timeout) => {
                    let waiting = self.waiting.lock();
                    return Ok(Next::NotYet(
                        *waiting.unwrap_or_else(PoisonError::into_inner),
                    ));
                }
                Err(mpsc::RecvTimeoutError::Disconnected) if self.shutdown.is_set() => break,
                Err(mpsc::RecvTimeoutError::Disconnected) => {
                    return Err(BatchError::ThreadsEnded);
                }
            }
        }
        Ok(Next::Finished)
    }
}

/// The one batch that is assembled from the parts of several shards. It outlives a failed try, because a part that was
/// given is counted as sampled.
struct PartialBatch {
    counts: Vec<Count>,
    /// Rows that are still to come from each shard.
    pending: Vec<u32>,
    /// The chance with which each row was given to each shard.
    shares: Vec<f64>,
    /// The request for a part that each shard gets next.
    ids: Vec<RequestId>,
    parts: Vec<Batch>,
    /// The shard of each part.
    from: Vec<ServedPart>,
    /// All transitions of the run are in.
    all_in: bool,
    /// When the last batch was whole.
    whole_at: Instant,
}

impl PartialBatch {
    fn new(shards: usize) -> Self {
        Self {
            counts: vec![Count::default(); shards],
            pending: vec![0; shards],
            shares: vec![0.0; shards],
            ids: vec![RequestId::first(rand::random()); shards],
            parts: Vec::new(),
            from: Vec::new(),
            all_in: false,
            whole_at: Instant::now(),
        }
    }
}

struct Fetcher {
    clients: Vec<RunClient>,
    partial: Arc<Mutex<PartialBatch>>,
    /// The request for a whole batch that comes next.
    id: RequestId,
    rng: ChaCha8Rng,
    requests: Requests,
    counters: Arc<Counters>,
    pool: BufferPool,
    /// Whether batches may come through shared memory.
    trust: Trust,
    said: Seldom,
    waiting: Arc<Mutex<Waiting>>,
    shutdown: Shutdown,
}

impl Fetcher {
    fn run(mut self, sender: &mpsc::SyncSender<Fetched>) {
        let mut answered = Instant::now();
        while !self.shutdown.is_set() {
            fault::point("batches");
            let fetched = match self.fetch() {
                Ok(None) => {
                    answered = Instant::now();
                    continue;
                }
                Ok(Some(fetched)) => fetched,
                Err(e)
                    if !e.is_recovering() && answered.elapsed() > self.requests.unreachable_max =>
                {
                    Fetched::Failed(BatchError::Unreachable {
                        unreachable_max: self.requests.unreachable_max,
                        source: Box::new(e),
                    })
                }
                Err(e) => {
                    if e.is_recovering() {
                        answered = Instant::now();
                    }
                    if let Some(more) = self.said.due() {
                        tracing::warn!("asking for a batch again: {e}{more}");
                    }
                    self.shutdown.wait_timeout(RETRY_PAUSE);
                    continue;
                }
            };
            if let Fetched::Batch(served) = &fetched {
                let header = &served.batch.header;
                let (newest, oldest) = header.weights_versions;
                tracing::debug!(
                    "a batch came: {} rows acted by weights {oldest} to {newest}",
                    header.rows
                );
            }
            let last = !matches!(fetched, Fetched::Batch(_));
            if sender.send(fetched).is_err() || last {
                return;
            }
            answered = Instant::now();
        }
    }

    /// One batch; `None` where the replay has nothing yet.
    fn fetch(&mut self) -> Result<Option<Fetched>, BatchError> {
        if self.clients.len() > 1 {
            return self.fetch_from_shards();
        }
        self.id = self.id.again();
        let asked = self.ask(0, self.id, self.requests.rows, None)?;
        let answer = self.answer(asked)?;
        self.id = self.id.next();
        Ok(match answer {
            Answer::Batch(batch) => {
                let parts = vec![self.received(0, &batch)];
                Some(Fetched::Batch(Box::new(Served { batch, parts })))
            }
            Answer::Wait => None,
            Answer::Finished => Some(Fetched::Finished),
            Answer::Refused(why) => Some(Fetched::Failed(BatchError::Refused(why))),
        })
    }

    /// Counts what has come from a shard.
    fn received(&self, shard: usize, part: &Batch) -> ServedPart {
        let rows = part.header.rows;
        self.counters.received[shard].fetch_add(rows.into(), Ordering::AcqRel);
        ServedPart {
            shard,
            rows,
            inserted: part.header.tally.inserted,
        }
    }

    /// One batch, put together from what the shards give. One is put together at a time: each shard is told what the others
    /// give, so that their rate limiters decide as one.
    fn fetch_from_shards(&mut self) -> Result<Option<Fetched>, BatchError> {
        let partial = self.partial.clone();
        let mut partial = partial.lock().unwrap_or_else(PoisonError::into_inner);
        if partial.parts.is_empty() && partial.pending.iter().all(|&rows| rows == 0) {
            self.recount(&mut partial, |count, now| count.is_old(now))?;
            match shards::split(self.requests.rows, &partial.counts, &mut self.rng) {
                Some(split) => {
                    partial.pending = split;
                    partial.shares = shards::shares(&partial.counts);
                }
                // A run that had all its updates when it was resumed: nothing comes to be held any more.
                None if partial.all_in => return Ok(Some(Fetched::Finished)),
                None => {
                    self.shutdown.wait_timeout(LOOK_AGAIN);
                    return Ok(None);
                }
            }
        }
        let PartialBatch {
            counts,
            pending,
            shares,
            ids,
            parts,
            from,
            ..
        } = &mut *partial;
        let mut asked = Vec::new();
        for shard in (0..pending.len()).filter(|&shard| pending[shard] > 0) {
            let other_shards = shards::other_shards(counts, pending, shard);
            ids[shard] = ids[shard].again();
            let part = self.ask(shard, ids[shard], pending[shard], Some(other_shards))?;
            asked.push((shard, part));
        }
        let (mut finished, mut failed) = (false, None);
        for (shard, asked) in asked {
            // A part that did not arrive is requested again, alone.
            let answer = match self.answer(asked) {
                Ok(answer) => answer,
                Err(e) => {
                    failed.get_or_insert(e);
                    continue;
                }
            };
            ids[shard] = ids[shard].next();
            match answer {
                Answer::Batch(mut part) => {
                    counts[shard] = Count {
                        tally: part.header.tally,
                        held: part.header.held,
                        last_seen: Some(Instant::now()),
                    };
                    from.push(self.received(shard, &part));
                    pending[shard] = 0;
                    if part.header.origin.is_some() {
                        part.scale_probabilities(shares[shard] as f32);
                    }
                    parts.push(part);
                }
                Answer::Wait => {}
                Answer::Finished => finished = true,
                Answer::Refused(why) => {
                    return Ok(Some(Fetched::Failed(BatchError::Refused(why))));
                }
            }
        }
        if let Some(e) = failed {
            return Err(e);
        }
        if pending.iter().all(|&rows| rows == 0) {
            let header = Batch::merged_header(parts).ok_or(BatchError::DifferentShards)?;
            let memory = self.pool.take_own(header.payload_bytes());
            let batch = Batch::merge(parts, memory);
            parts.clear();
            let parts = std::mem::take(from);
            partial.whole_at = Instant::now();
            return Ok(Some(Fetched::Batch(Box::new(Served { batch, parts }))));
        }
        self.recount(&mut partial, |_, _| true)?;
        // A shard that has given its part knows of the others' transitions what they had then: it may be wrong about the end.
        let is_over = finished && partial.parts.is_empty();
        if !is_over && partial.all_in && partial.whole_at.elapsed() > LAST_BATCH_MAX {
            let left = partial.pending.iter().enumerate();
            let left = left.filter(|(_, rows)| **rows > 0);
            let left: Vec<_> = left
                .map(|(shard, rows)| format!("{rows} rows of shard {shard}"))
                .collect();
            tracing::warn!(
                "all transitions are in, and the last batch lacks {} since {} s: it is left out",
                left.join(" and "),
                LAST_BATCH_MAX.as_secs()
            );
            return Ok(Some(Fetched::Finished));
        }
        Ok(is_over.then_some(Fetched::Finished))
    }

    /// Asks the shards for which `is_due` says so what they have counted.
    fn recount(
        &self,
        partial: &mut PartialBatch,
        is_due: impl Fn(&Count, Instant) -> bool,
    ) -> Result<(), BatchError> {
        let now = Instant::now();
        for (client, count) in self.clients.iter().zip(&mut partial.counts) {
            if !is_due(count, now) {
                continue;
            }
            let status: ReplayStatus = client.fetch(REQUEST_TIMEOUT).map_err(BatchError::Status)?;
            *count = Count {
                tally: Tally {
                    inserted: status.transitions_inserted,
                    rows_sampled: status.rows_sampled,
                },
                held: status.transitions_held,
                last_seen: Some(Instant::now()),
            };
            partial.all_in |= status.finished;
        }
        Ok(())
    }

    /// Asks a shard for `rows` rows.
    fn ask(
        &mut self,
        shard: usize,
        id: RequestId,
        rows: u32,
        other_shards: Option<Tally>,
    ) -> Result<(PendingReply<BatchReply>, bool), BatchError> {
        let request = BatchRequest {
            learner: self.requests.learner,
            id,
            rows,
            shared_memory: self.requests.shared_memory && self.trust.ask(),
            learned: self.counters.learned(shard),
            other_shards,
        };
        let client = &self.clients[shard];
        let asked = client.send(client.seal(&request)?, REQUEST_TIMEOUT)?;
        Ok((asked, request.shared_memory))
    }

    fn answer(
        &mut self,
        (asked, shared_memory): (PendingReply<BatchReply>, bool),
    ) -> Result<Answer, BatchError> {
        // A process that may not map shared memory never sees the reply: to it the request looks unanswered.
        let (reply, payload) = asked.receive(&self.pool).inspect_err(|e| {
            let unheard = matches!(
                e,
                SessionError::NoReply { .. } | SessionError::NoAnswerer { .. }
            );
            if shared_memory && unheard {
                self.trust.lost();
            }
        })?;
        Ok(match reply {
            BatchReply::Batch(_) | BatchReply::Prioritised(..) | BatchReply::Stacked(..) => {
                if shared_memory {
                    self.trust.worked();
                }
                let header = reply.header().expect("a batch has a header");
                Answer::Batch(Batch::from_payload(header, payload)?)
            }
            BatchReply::Wait(waiting) => {
                *self.waiting.lock().unwrap_or_else(PoisonError::into_inner) = waiting;
                Answer::Wait
            }
            BatchReply::Finished => Answer::Finished,
            BatchReply::Refused { why } => Answer::Refused(why),
        })
    }
}

/// What a replay server answers.
enum Answer {
    Batch(Batch),
    Wait,
    Finished,
    Refused(String),
}
