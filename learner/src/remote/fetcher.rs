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

use anyhow::{Context, bail};
use driml_protocol::{
    Batch, BatchReply, BatchRequest, BufferPool, LearnerProgress, LogLimiter, NotReady,
    PendingReply, ReplayStatus, RequestId, RunClient, ShardCounts, Shutdown, Silence, Waiting,
    fail_point, lock, session::SessionError, shared_memory::Trust,
};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::shards::{PartialBatch, ShardState};
use crate::run_counts::{BatchPart, RunCounts};

/// Time-out of a request at first. A replay server replies within a second, if only that it has no batch yet.
const REQUEST_TIMEOUT: Duration = Duration::from_secs(10);
/// Longest time-out of a request, for batches over a slow link.
const SLOW_REQUEST_TIMEOUT: Duration = Duration::from_secs(160);
/// Pause before a retry when the replay server is unreachable.
const RETRY_PAUSE: Duration = Duration::from_millis(200);
/// Pause before empty shards are asked again.
const EMPTY_SHARDS_PAUSE: Duration = Duration::from_millis(50);
/// How long to wait for the last batch once all transitions are stored and no shard refills its memory.
const LAST_BATCH_MAX: Duration = Duration::from_secs(30);

/// What the threads request, for which learner, and how.
#[derive(Clone, Copy, Debug)]
pub struct Requests {
    /// Identifier of the learner that has joined the run.
    pub learner_id: u64,
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
    rows_received: Vec<AtomicU64>,
}

impl Counters {
    /// The counters of a learner after `updates` updates, all of which are saved.
    pub fn new(updates: u64, counts: &RunCounts) -> Arc<Self> {
        let shards = counts.shards.iter();
        Arc::new(Self {
            updates: updates.into(),
            saved_updates: updates.into(),
            rows_received: shards.map(|it| it.rows_sampled.into()).collect(),
        })
    }

    /// The counters of a learner that has learned nothing.
    pub fn at_start(shards: usize) -> Arc<Self> {
        let mut counts = RunCounts::default();
        counts.spread_over(shards);
        Self::new(0, &counts)
    }

    fn learned(&self, shard: usize) -> LearnerProgress {
        LearnerProgress {
            updates: self.updates.load(Ordering::Acquire),
            saved_updates: self.saved_updates.load(Ordering::Acquire),
            rows_received: self.rows_received[shard].load(Ordering::Acquire),
        }
    }
}

/// A batch, and the shards that its rows come from.
pub struct ServedBatch {
    /// The batch to learn from.
    pub batch: Batch,
    /// The batch's rows by shard.
    pub parts: Vec<BatchPart>,
}

/// The result of waiting for the next batch.
pub enum NextBatch {
    /// A batch to learn from.
    Ready(Box<ServedBatch>),
    /// No batch arrived within the time-out; call again. The replay server reports which side waits for the other.
    NotYet(Waiting),
    /// The run is over: no further batch will come.
    Finished,
}

/// What a fetching thread sends: a batch, or why it ends.
pub(super) type Fetched = anyhow::Result<NextBatch>;

/// The replay server rejects the request, and would reject a retry.
#[derive(Debug, thiserror::Error)]
#[error("the replay server rejects the learner: {0}")]
struct Rejected(String);

pub(super) struct SharedState {
    clients: Vec<RunClient>,
    requests: Requests,
    counters: Arc<Counters>,
    pool: BufferPool,
    partial: Mutex<PartialBatch>,
    waiting: Mutex<Waiting>,
    pub(super) shutdown: Shutdown,
}

impl SharedState {
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
    shared: Arc<SharedState>,
    /// Identifier of the next request for a whole batch.
    request_id: RequestId,
    rng: ChaCha8Rng,
    /// Time-out of the next request: twice that of the last late one, or twice the time that the last batch took.
    timeout: Duration,
    /// Whether batches may come through shared memory.
    trust: Trust,
    log_limiter: LogLimiter,
}

/// A request for a batch, or for a shard's part of one, whose reply is awaited.
struct SentRequest {
    reply: PendingReply<BatchReply>,
    shared_memory: bool,
    sent: Instant,
}

impl Fetcher {
    pub(super) fn new(shared: &Arc<SharedState>) -> Self {
        // The order of replies decides which rows come from which shard, so this need not be the run's generator.
        let mut rng = ChaCha8Rng::from_os_rng();
        Self {
            shared: shared.clone(),
            request_id: RequestId::first(rng.random()),
            rng,
            timeout: REQUEST_TIMEOUT,
            trust: Trust::default(),
            log_limiter: LogLimiter::default(),
        }
    }

    pub(super) fn run(mut self, sender: &mpsc::SyncSender<Fetched>) {
        // With several shards the threads take turns, so that a thread's tries lie as far apart as the time-outs of all.
        let shared = &self.shared;
        let turns = match shared.clients.len() {
            1 => 1,
            _ => shared.requests.in_flight,
        };
        let mut silence = Silence::default();
        while !self.shared.shutdown.is_set() {
            fail_point::reach("batches");
            silence.set_try_timeout(self.timeout * turns);
            let fetched = self.fetch();
            let fetched = match fetched {
                Ok(NextBatch::NotYet(_)) => {
                    silence.record_answer();
                    continue;
                }
                Err(e) if !e.is::<Rejected>() => {
                    // A server that recovers its replay from disk is reachable, and will serve batches later.
                    if let Some(SessionError::Recovering(_)) = e.downcast_ref() {
                        silence.record_answer();
                    }
                    let unreachable_max = self.shared.requests.unreachable_max;
                    if silence.record_failure() <= unreachable_max {
                        // At a shutdown the server may be gone already.
                        if !self.shared.shutdown.is_set()
                            && let Some(more) = self.log_limiter.admit()
                        {
                            tracing::warn!("retrying the request for a batch: {e:#}{more}");
                        }
                        self.shared.shutdown.wait_timeout(RETRY_PAUSE);
                        continue;
                    }
                    Err(e.context(format!("no batch and no answer for {unreachable_max:?}")))
                }
                fetched => fetched,
            };
            let is_last = !matches!(fetched, Ok(NextBatch::Ready(_)));
            if let Ok(NextBatch::Ready(served)) = &fetched {
                let header = &served.batch.header;
                let (rows, (newest, oldest)) = (header.rows, header.weights_versions);
                tracing::debug!("a batch came: {rows} rows acted by weights {oldest} to {newest}");
            }
            if sender.send(fetched).is_err() || is_last {
                return;
            }
            silence.record_answer();
        }
    }

    /// Fetches one batch, if the replay has one already.
    fn fetch(&mut self) -> Fetched {
        if self.shared.clients.len() > 1 {
            return self.fetch_from_shards();
        }
        self.request_id = self.request_id.retry();
        let pending = self.send_request(0, self.request_id, self.shared.requests.rows, None)?;
        let reply = self.receive_reply(pending)?;
        self.request_id = self.request_id.next();
        match reply {
            Ok(batch) => {
                let parts = vec![self.count_received(0, &batch)];
                Ok(NextBatch::Ready(Box::new(ServedBatch { batch, parts })))
            }
            Err(NotReady::Wait(waiting)) => Ok(NextBatch::NotYet(waiting)),
            Err(NotReady::Finished) => Ok(NextBatch::Finished),
            Err(NotReady::Refused { why }) => Err(Rejected(why).into()),
        }
    }

    /// Counts the rows received from a shard.
    fn count_received(&self, shard: usize, part: &Batch) -> BatchPart {
        let rows = part.header.rows;
        self.shared.counters.rows_received[shard].fetch_add(rows.into(), Ordering::AcqRel);
        BatchPart {
            shard,
            rows,
            inserted: part.header.counts.inserted,
        }
    }

    /// Assembles one batch from the parts of the shards. Only one batch is assembled at a time: each shard is told the counts of the
    /// others, so that their rate limiters decide as one.
    fn fetch_from_shards(&mut self) -> Fetched {
        let shared = self.shared.clone();
        let mut partial = lock(&shared.partial);
        if partial.parts.is_empty() && partial.is_complete() {
            self.fetch_counts(&mut partial, ShardState::is_stale)?;
            if !partial.begin(self.shared.requests.rows, &mut self.rng) {
                // The run had all its updates when it was resumed: the shards stay empty.
                if partial.all_stored {
                    return Ok(NextBatch::Finished);
                }
                self.shared.shutdown.wait_timeout(EMPTY_SHARDS_PAUSE);
                return Ok(NextBatch::NotYet(self.shared.waiting()));
            }
        }
        let mut pending_replies = Vec::new();
        for shard in 0..partial.shards.len() {
            let others = partial.other_shards(shard);
            let state = &mut partial.shards[shard];
            if state.pending_rows > 0 {
                state.id = state.id.retry();
                let reply = self.send_request(shard, state.id, state.pending_rows, Some(others))?;
                pending_replies.push((shard, reply));
            }
        }
        let (mut finished, mut refused, mut failed) = (false, None, None);
        for (shard, pending) in pending_replies {
            // Only the part that did not arrive is requested again.
            let reply = match self.receive_reply(pending) {
                Ok(reply) => reply,
                Err(e) => {
                    failed.get_or_insert(e);
                    continue;
                }
            };
            let state = &mut partial.shards[shard];
            state.id = state.id.next();
            match reply {
                Ok(mut part) => {
                    state.record_counts(part.header.counts, part.header.held);
                    state.pending_rows = 0;
                    if part.header.origin.is_some() {
                        part.scale_probabilities(state.share as f32);
                    }
                    partial.sources.push(self.count_received(shard, &part));
                    partial.parts.push(part);
                }
                Err(NotReady::Wait(waiting)) => partial.record_waiting(waiting),
                Err(NotReady::Finished) => finished = true,
                Err(NotReady::Refused { why }) => refused = Some((shard, why)),
            }
        }
        if let Some(e) = failed {
            return Err(e);
        }
        if partial.is_complete() {
            let allocate = |bytes| self.shared.pool.take_private(bytes);
            let batch = Batch::merge(&partial.parts, allocate);
            let batch = batch.context("the shards' parts do not fit together")?;
            partial.parts.clear();
            let parts = std::mem::take(&mut partial.sources);
            partial.since_last_batch.record_answer();
            return Ok(NextBatch::Ready(Box::new(ServedBatch { batch, parts })));
        }
        self.fetch_counts(&mut partial, |_, _| true)?;
        partial.reassign_rows(&mut self.rng);
        if let Some((_, why)) = refused.filter(|(shard, _)| partial.shards[*shard].pending_rows > 0)
        {
            bail!(Rejected(why));
        }
        // Once a part has come, a shard that reports the end may have been told outdated counts of the other shards.
        let is_over = finished && partial.parts.is_empty();
        let waited = partial.since_last_batch.record_failure();
        if !is_over && partial.all_stored && waited > LAST_BATCH_MAX {
            let left = partial.shards.iter().enumerate();
            let left = left.filter(|(_, state)| state.pending_rows > 0);
            let left: Vec<_> = left
                .map(|(shard, state)| format!("{} rows of shard {shard}", state.pending_rows))
                .collect();
            tracing::warn!(
                "all transitions are stored, and the last batch has lacked {} for {} s: it is skipped",
                left.join(" and "),
                LAST_BATCH_MAX.as_secs()
            );
            return Ok(NextBatch::Finished);
        }
        if partial.parts.is_empty() {
            // No part came, so draw anew: a shard that was not asked may hold back inserts until a request tells it how far the run is.
            partial.abandon();
        }
        Ok(match is_over {
            true => NextBatch::Finished,
            false => NextBatch::NotYet(self.shared.waiting()),
        })
    }

    /// Fetches the counts of the shards for which `is_due` is true.
    fn fetch_counts(
        &self,
        partial: &mut PartialBatch,
        is_due: impl Fn(&ShardState, Instant) -> bool,
    ) -> anyhow::Result<()> {
        let (now, mut all_stored) = (Instant::now(), false);
        let shards = self.shared.clients.iter().zip(&mut partial.shards);
        for (shard, (client, state)) in shards.enumerate() {
            if !is_due(state, now) {
                continue;
            }
            let status = client.fetch::<ReplayStatus>(REQUEST_TIMEOUT);
            let status = status.context("a shard's status")?;
            let received = self.shared.counters.learned(shard).rows_received;
            state.record_status(&status, received);
            all_stored |= status.finished;
        }
        partial.set_stored(all_stored);
        Ok(())
    }

    fn send_request(
        &mut self,
        shard: usize,
        id: RequestId,
        rows: u32,
        other_shards: Option<ShardCounts>,
    ) -> anyhow::Result<SentRequest> {
        let request = BatchRequest {
            learner: self.shared.requests.learner_id,
            id,
            rows,
            shared_memory: self.shared.requests.shared_memory && self.trust.may_use(),
            learned: self.shared.counters.learned(shard),
            other_shards,
        };
        let client = &self.shared.clients[shard];
        Ok(SentRequest {
            reply: client.send(client.encode(&request)?, self.timeout)?,
            shared_memory: request.shared_memory,
            sent: Instant::now(),
        })
    }

    /// Receives a shard's reply: a batch, or why there is none.
    fn receive_reply(&mut self, pending: SentRequest) -> anyhow::Result<Result<Batch, NotReady>> {
        let (shared_memory, sent) = (pending.shared_memory, pending.sent);
        let received = pending.reply.receive(&self.shared.pool);
        let (reply, payload) = received.inspect_err(|e| {
            let is_late = matches!(e, SessionError::TimedOut { .. });
            let is_lost = is_late || matches!(e, SessionError::NoResponder { .. });
            // A process that may not map shared memory never receives the reply: the request looks unanswered.
            if shared_memory && is_lost {
                self.trust.record_loss();
            } else if is_late {
                self.timeout = (self.timeout * 2).min(SLOW_REQUEST_TIMEOUT);
            }
        })?;
        Ok(match reply {
            BatchReply::Batch(header) => {
                self.trust.record_arrival(shared_memory);
                let twice = 2 * sent.elapsed();
                self.timeout = twice.clamp(REQUEST_TIMEOUT, SLOW_REQUEST_TIMEOUT);
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
