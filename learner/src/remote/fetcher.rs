//! One thread that fetches batches: from one replay server, or assembled from the parts of several shards.
//! It does not queue them: `batch_source` does.

use std::{
    sync::{
        Arc, Mutex,
        atomic::{AtomicU64, Ordering},
        mpsc,
    },
    time::{Duration, Instant},
};

use driml_protocol::{
    Batch, BatchReply, BatchRequest, BufferPool, Learned, LogLimiter, NotReady, PendingReply,
    ReplayStatus, RequestId, RunClient, ShardCounts, Shutdown, Silence, Waiting, fail_point, lock,
    session::SessionError, shared_memory::Trust,
};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::{
    error::BatchError,
    shards::{PartialBatch, Portion},
};
use crate::run_counts::{BatchPart, RunCounts};

/// Time-out of a request. A replay server replies within a second, if only that it has no batch yet.
const REQUEST_TIMEOUT: Duration = Duration::from_secs(10);
/// Pause before a retry when the replay server is unreachable.
const RETRY_PAUSE: Duration = Duration::from_millis(200);

/// Pause before empty shards are asked again.
const LOOK_AGAIN: Duration = Duration::from_millis(50);
/// How long to wait for the last batch once all transitions are stored and no shard refills its memory.
const LAST_BATCH_MAX: Duration = Duration::from_secs(30);
/// What the threads request, for which learner, and how.
#[derive(Clone, Copy, Debug)]
pub struct Requests {
    /// Identifier of the learner that has joined the run.
    pub learner: u64,
    /// Rows of a batch.
    pub rows: u32,
    /// Number of requests in flight, each with its own thread.
    pub in_flight: u32,
    /// Whether batches may come through shared memory.
    pub shared_memory: bool,
    /// How long the replay server may be unreachable before the learner gives up.
    pub unreachable_max: Duration,
}

/// The learner's counts, which it sends with each request.
#[derive(Debug)]
pub struct Counters {
    /// Updates done in the whole run.
    pub updates: AtomicU64,
    /// Updates in the newest checkpoint.
    pub saved_updates: AtomicU64,
    /// Rows received from each shard.
    received: Vec<AtomicU64>,
}

impl Counters {
    /// The counters of a learner after `updates` updates, all of which are saved.
    pub fn of(updates: u64, counts: &RunCounts) -> Arc<Self> {
        let shards = counts.shards.iter();
        Arc::new(Self {
            updates: updates.into(),
            saved_updates: updates.into(),
            received: shards.map(|it| it.rows_sampled.into()).collect(),
        })
    }

    /// The counters of a learner that has learned nothing.
    pub fn at_start(shards: usize) -> Arc<Self> {
        let mut counts = RunCounts::default();
        counts.spread_over(shards);
        Self::of(0, &counts)
    }

    fn learned(&self, shard: usize) -> Learned {
        Learned {
            updates: self.updates.load(Ordering::Acquire),
            saved_updates: self.saved_updates.load(Ordering::Acquire),
            rows_received: self.received[shard].load(Ordering::Acquire),
        }
    }
}

/// A batch, and the shards that its rows come from.
pub struct Served {
    /// The batch to learn from.
    pub batch: Batch,
    /// The batch's rows by shard.
    pub parts: Vec<BatchPart>,
}

/// A message from a fetching thread.
pub(super) enum Fetched {
    Batch(Box<Served>),
    Finished,
    Failed(BatchError),
}

pub(super) struct Shared {
    clients: Vec<RunClient>,
    requests: Requests,
    counters: Arc<Counters>,
    pool: BufferPool,
    partial: Mutex<PartialBatch>,
    waiting: Mutex<Waiting>,
    pub(super) shutdown: Shutdown,
}

impl Shared {
    pub(super) fn new(
        clients: &[RunClient],
        requests: Requests,
        counters: &Arc<Counters>,
        shutdown: &Shutdown,
    ) -> Arc<Self> {
        Arc::new(Self {
            clients: clients.to_vec(),
            requests,
            counters: counters.clone(),
            // With one replay server: a batch per thread, and the batch being learned from.
            pool: BufferPool::new(requests.in_flight as usize + clients.len()),
            partial: Mutex::new(PartialBatch::new(clients.len())),
            waiting: Mutex::default(),
            shutdown: shutdown.clone(),
        })
    }

    /// Which side waits for the other, according to the last reply without a batch.
    pub(super) fn waiting(&self) -> Waiting {
        *lock(&self.waiting)
    }
}

pub(super) struct Fetcher {
    shared: Arc<Shared>,
    /// Identifier of the next request for a whole batch.
    id: RequestId,
    rng: ChaCha8Rng,
    /// Whether batches may come through shared memory.
    trust: Trust,
    said: LogLimiter,
}

impl Fetcher {
    pub(super) fn new(shared: &Arc<Shared>) -> Self {
        // The order of replies decides which rows come from which shard, so this need not be the run's generator.
        let mut rng = ChaCha8Rng::from_os_rng();
        Self {
            shared: shared.clone(),
            id: RequestId::first(rng.random()),
            rng,
            trust: Trust::default(),
            said: LogLimiter::default(),
        }
    }

    pub(super) fn run(mut self, sender: &mpsc::SyncSender<Fetched>) {
        let mut silence = Silence::default();
        while !self.shared.shutdown.is_set() {
            fail_point::reach("batches");
            let fetched = match self.fetch() {
                Ok(None) => {
                    silence.answered();
                    continue;
                }
                Ok(Some(fetched)) => fetched,
                Err(e) => {
                    if e.is_recovering() {
                        silence.answered();
                    }
                    let unreachable_max = self.shared.requests.unreachable_max;
                    if silence.unanswered() <= unreachable_max {
                        // At a shutdown the server may be gone already.
                        if !self.shared.shutdown.is_set()
                            && let Some(more) = self.said.due()
                        {
                            tracing::warn!("asking for a batch again: {e}{more}");
                        }
                        self.shared.shutdown.wait_timeout(RETRY_PAUSE);
                        continue;
                    }
                    Fetched::Failed(BatchError::Unreachable {
                        unreachable_max,
                        source: Box::new(e),
                    })
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
            silence.answered();
        }
    }

    /// Fetches one batch; `None` if the replay has none yet.
    fn fetch(&mut self) -> Result<Option<Fetched>, BatchError> {
        if self.shared.clients.len() > 1 {
            return self.fetch_from_shards();
        }
        self.id = self.id.again();
        let asked = self.ask(0, self.id, self.shared.requests.rows, None)?;
        let answer = self.answer(asked)?;
        self.id = self.id.next();
        Ok(match answer {
            Ok(batch) => {
                let parts = vec![self.received(0, &batch)];
                Some(Fetched::Batch(Box::new(Served { batch, parts })))
            }
            Err(NotReady::Wait(_)) => None,
            Err(NotReady::Finished) => Some(Fetched::Finished),
            Err(NotReady::Refused { why }) => Some(Fetched::Failed(BatchError::Refused(why))),
        })
    }

    /// Counts the rows received from a shard.
    fn received(&self, shard: usize, part: &Batch) -> BatchPart {
        let rows = part.header.rows;
        self.shared.counters.received[shard].fetch_add(rows.into(), Ordering::AcqRel);
        BatchPart {
            shard,
            rows,
            inserted: part.header.counts.inserted,
        }
    }

    /// Assembles one batch from the parts of the shards. Only one batch is assembled at a time: each shard is told the counts of the
    /// others, so that their rate limiters decide as one.
    fn fetch_from_shards(&mut self) -> Result<Option<Fetched>, BatchError> {
        let shared = self.shared.clone();
        let mut partial = lock(&shared.partial);
        if partial.parts.is_empty() && partial.is_whole() {
            self.recount(&mut partial, Portion::is_old)?;
            if !partial.begin(self.shared.requests.rows, &mut self.rng) {
                // The run had all its updates when it was resumed: the shards stay empty.
                if partial.all_in {
                    return Ok(Some(Fetched::Finished));
                }
                self.shared.shutdown.wait_timeout(LOOK_AGAIN);
                return Ok(None);
            }
        }
        let mut asked = Vec::new();
        for shard in 0..partial.portions.len() {
            let other_shards = partial.other_shards(shard);
            let portion = &mut partial.portions[shard];
            if portion.pending > 0 {
                portion.id = portion.id.again();
                let part = self.ask(shard, portion.id, portion.pending, Some(other_shards))?;
                asked.push((shard, part));
            }
        }
        let (mut finished, mut failed) = (false, None);
        for (shard, asked) in asked {
            // Only the part that did not arrive is requested again.
            let answer = match self.answer(asked) {
                Ok(answer) => answer,
                Err(e) => {
                    failed.get_or_insert(e);
                    continue;
                }
            };
            let portion = &mut partial.portions[shard];
            portion.id = portion.id.next();
            match answer {
                Ok(mut part) => {
                    portion.note(part.header.counts, part.header.held);
                    portion.pending = 0;
                    if part.header.origin.is_some() {
                        part.scale_probabilities(portion.share as f32);
                    }
                    partial.from.push(self.received(shard, &part));
                    partial.parts.push(part);
                }
                Err(NotReady::Wait(waiting)) => partial.note_waiting(waiting),
                Err(NotReady::Finished) => finished = true,
                Err(NotReady::Refused { why }) => {
                    return Ok(Some(Fetched::Failed(BatchError::Refused(why))));
                }
            }
        }
        if let Some(e) = failed {
            return Err(e);
        }
        if partial.is_whole() {
            let header = Batch::merged_header(&partial.parts);
            let header = header.ok_or(BatchError::DifferentShards)?;
            let memory = self.shared.pool.take_own(header.payload_bytes());
            let batch = Batch::merge(&partial.parts, memory);
            partial.parts.clear();
            let parts = std::mem::take(&mut partial.from);
            partial.since_whole.answered();
            return Ok(Some(Fetched::Batch(Box::new(Served { batch, parts }))));
        }
        self.recount(&mut partial, |_, _| true)?;
        // Once a part has come, a shard that reports the end may have been told outdated counts of the other shards.
        let is_over = finished && partial.parts.is_empty();
        let waited = partial.since_whole.unanswered();
        if !is_over && partial.all_in && waited > LAST_BATCH_MAX {
            let left = partial.portions.iter().enumerate();
            let left = left.filter(|(_, portion)| portion.pending > 0);
            let left: Vec<_> = left
                .map(|(shard, portion)| format!("{} rows of shard {shard}", portion.pending))
                .collect();
            tracing::warn!(
                "all transitions are in, and the last batch lacks {} since {} s: it is left out",
                left.join(" and "),
                LAST_BATCH_MAX.as_secs()
            );
            return Ok(Some(Fetched::Finished));
        }
        if partial.parts.is_empty() {
            // No part came, so draw anew: a shard that was not asked may hold back inserts until a request tells it how far the run is.
            partial.withdraw();
        }
        Ok(is_over.then_some(Fetched::Finished))
    }

    /// Fetches the counts of the shards for which `is_due` is true.
    fn recount(
        &self,
        partial: &mut PartialBatch,
        is_due: impl Fn(&Portion, Instant) -> bool,
    ) -> Result<(), BatchError> {
        let (now, mut all_in) = (Instant::now(), false);
        for (client, portion) in self.shared.clients.iter().zip(&mut partial.portions) {
            if !is_due(portion, now) {
                continue;
            }
            let status: ReplayStatus = client.fetch(REQUEST_TIMEOUT).map_err(BatchError::Status)?;
            let counts = ShardCounts {
                inserted: status.transitions_inserted,
                rows_sampled: status.rows_sampled,
            };
            portion.note(counts, status.transitions_held);
            all_in |= status.finished;
        }
        partial.note_all_in(all_in);
        Ok(())
    }

    fn ask(
        &mut self,
        shard: usize,
        id: RequestId,
        rows: u32,
        other_shards: Option<ShardCounts>,
    ) -> Result<(PendingReply<BatchReply>, bool), BatchError> {
        let request = BatchRequest {
            learner: self.shared.requests.learner,
            id,
            rows,
            shared_memory: self.shared.requests.shared_memory && self.trust.ask(),
            learned: self.shared.counters.learned(shard),
            other_shards,
        };
        let client = &self.shared.clients[shard];
        let asked = client.send(client.seal(&request)?, REQUEST_TIMEOUT)?;
        Ok((asked, request.shared_memory))
    }

    /// Receives a shard's reply: a batch, or why there is none.
    fn answer(
        &mut self,
        (asked, shared_memory): (PendingReply<BatchReply>, bool),
    ) -> Result<Result<Batch, NotReady>, BatchError> {
        // A process that may not map shared memory never receives the reply: the request looks unanswered.
        let (reply, payload) = asked.receive(&self.shared.pool).inspect_err(|e| {
            let unheard = matches!(
                e,
                SessionError::NoReply { .. } | SessionError::NoAnswerer { .. }
            );
            if shared_memory && unheard {
                self.trust.lost();
            }
        })?;
        Ok(match reply {
            BatchReply::Batch(header) => {
                if shared_memory {
                    self.trust.worked();
                }
                Ok(Batch::from_payload(header, payload)?)
            }
            BatchReply::NotReady(not_ready) => {
                if let NotReady::Wait(waiting) = not_ready {
                    *lock(&self.shared.waiting) = waiting;
                }
                Err(not_ready)
            }
        })
    }
}
