//! The delivery thread: sends chunks, handles the replies, and sends a chunk again if it did not arrive.
//! It never waits long without a reply: a replay server that holds a chunk replies every few seconds, and delivery
//! fails if the server stays unresponsive.

use std::{
    collections::VecDeque,
    sync::{Arc, mpsc},
    time::{Duration, Instant},
};

use anyhow::bail;
use driml_protocol::{
    ActorJoin, BufferPool, Chunk, ChunkHeader, ChunkPoll, InsertReply, Leave, LogLimiter,
    PendingReply, RunClient, Shutdown, Silence, fail_point, is_readable, lock,
    session::SessionError,
};
use zenoh::bytes::ZBytes;

use super::state::{DeliveryLimits, DeliveryState};

/// How long the queued chunks may take to be stored after `Shutdown`.
const DRAIN_MAX: Duration = Duration::from_secs(20);
/// Time-out of the reply to one of these chunks, which is then sent again. Several tries must fit into [`DRAIN_MAX`]. Of a longer time
/// between two tries, in which this process was stopped, only twice as much counts.
const DRAIN_ACK_TIMEOUT: Duration = Duration::from_secs(4);
/// After so many stored chunks, one more may be in flight than before.
const WINDOW_TRIAL_CHUNKS: u64 = 64;
/// Pause between two tries when the replay server is out of reach or has no room.
const RETRY_PAUSE: Duration = Duration::from_millis(200);
/// How often the thread checks for `Shutdown`, and for the memory of its chunk, while it waits for a reply.
const CHECK_INTERVAL: Duration = Duration::from_millis(50);
/// How long `Leave` is retried, not counting the time in which the replay server reads its replay back from disk.
const LEAVE_RETRY_MAX: Duration = Duration::from_secs(5);
/// Time-out of one `Leave`. Several must fit into [`LEAVE_RETRY_MAX`], as a message may be lost.
const LEAVE_TIMEOUT: Duration = Duration::from_secs(1);

struct OutgoingChunk {
    header: ChunkHeader,
    payload: ZBytes,
    in_shared_memory: bool,
    /// The reply to the chunk, or to a poll about it, if one is pending.
    pending: Option<PendingReply<InsertReply>>,
    /// The replay server has the chunk and will store it, so that a poll is enough.
    is_kept: bool,
}

impl OutgoingChunk {
    fn copy_out_of_shared_memory(&mut self) {
        if self.in_shared_memory {
            self.payload = ZBytes::from(self.payload.to_bytes().into_owned());
            self.in_shared_memory = false;
        }
    }
}

/// The result for the first chunk in the queue.
enum Outcome {
    Stored,
    /// The run has enough transitions.
    Unwanted,
    /// The chunk, or a poll about it, must be sent again.
    Resend,
}

/// The delivery thread's state. Several chunks are in flight at once and are settled in order. If one must be sent
/// again, so must those after it, which the replay server has rejected as out of order.
pub(super) struct DeliveryWorker {
    client: RunClient,
    actor: ActorJoin,
    limits: DeliveryLimits,
    pool: BufferPool,
    shutdown: Shutdown,
    state: Arc<DeliveryState>,
    outgoing: VecDeque<OutgoingChunk>,
    /// The most chunks in flight: 1 after a chunk had to wait or be sent again, and 1 more for each chunk that is stored at once.
    window: usize,
    /// The largest window: half of one in which a chunk was late, as on a slow link each waits for those before it.
    window_max: usize,
    silence: Silence,
    /// When the rate limiter began to hold the first chunk.
    held_since: Option<Instant>,
    /// The last chunk for which the server expected an earlier one.
    out_of_order: Option<u64>,
    /// The time since the shutdown.
    draining: Option<Silence>,
    retry_log: LogLimiter,
    wait_log: LogLimiter,
}

impl DeliveryWorker {
    pub(super) fn new(
        client: RunClient,
        actor: ActorJoin,
        limits: DeliveryLimits,
        pool: BufferPool,
        shutdown: Shutdown,
        state: Arc<DeliveryState>,
    ) -> Self {
        Self {
            client,
            actor,
            limits,
            pool,
            shutdown,
            state,
            outgoing: VecDeque::new(),
            window: 1,
            window_max: limits.chunks_in_flight_max,
            silence: Silence::with_try_timeout(limits.ack_timeout),
            held_since: None,
            out_of_order: None,
            draining: None,
            retry_log: LogLimiter::default(),
            wait_log: LogLimiter::default(),
        }
    }

    /// Delivers chunks until the queue closes. Returns the number of transitions that the run did not want.
    pub(super) fn run(mut self, chunks: &mpsc::Receiver<Chunk>) -> anyhow::Result<u64> {
        let mut produced = 0;
        let mut unwanted = 0;
        let mut result = Ok(());
        while let Some(header) = self.first_header(chunks) {
            fail_point::reach("delivery");
            let transitions = header.transitions() as u64;
            // After a failure the other chunks are only counted, so that `Leave` has the number of all that the actor produced.
            let first_outcome = match result {
                Ok(()) => self.settle_first(),
                Err(_) => Ok(Outcome::Stored),
            };
            match first_outcome {
                Ok(Outcome::Resend) => continue,
                Ok(Outcome::Stored) => {}
                Ok(Outcome::Unwanted) => unwanted += transitions,
                Err(e) => {
                    result = Err(e);
                    lock(&self.state.progress).is_finished = true;
                }
            }
            produced += transitions;
            self.outgoing.pop_front();
            lock(&self.state.progress).in_flight -= 1;
            self.state.settled.notify_all();
        }
        // If delivery failed, the replay server counts the lost transitions by `Leave`.
        let is_missing = result.is_ok() && lock(&self.state.progress).has_failed;
        if !is_missing {
            let ActorJoin { actor, incarnation } = self.actor;
            self.send_leave(Leave::new(actor, incarnation, produced - unwanted));
        }
        result.map(|()| unwanted)
    }

    /// Takes chunks from the queue and returns the first one's header. Waits if there is none; `None` if the queue has closed.
    fn first_header(&mut self, chunks: &mpsc::Receiver<Chunk>) -> Option<ChunkHeader> {
        while self.outgoing.len() < self.limits.chunks_in_flight_max {
            let next = match self.outgoing.is_empty() {
                true => chunks.recv().ok(),
                false => chunks.try_recv().ok(),
            };
            let Some(chunk) = next else { break };
            if self.outgoing.is_empty() {
                // The time without chunks does not count as silence of the replay server.
                self.silence.record_answer();
            }
            let header = chunk.header;
            let payload = chunk.into_payload();
            self.outgoing.push_back(OutgoingChunk {
                header,
                in_shared_memory: payload.is_shared(),
                payload: payload.freeze(),
                pending: None,
                is_kept: false,
            });
        }
        if self.shutdown.is_set() {
            // Copying is cheap now. A chunk lost in shared memory would cost the time that is left.
            self.copy_out_of_shared_memory();
        }
        self.outgoing.front().map(|first| first.header)
    }

    /// Sends the chunks that the window allows and settles the first by its reply.
    fn settle_first(&mut self) -> anyhow::Result<Outcome> {
        let sequence = self.outgoing[0].header.sequence;
        if self.shutdown.is_set() {
            let begin = || Silence::with_gap_max(2 * DRAIN_ACK_TIMEOUT);
            if self.draining.get_or_insert_with(begin).record_failure() > DRAIN_MAX {
                bail!("chunk {sequence} was not stored within {DRAIN_MAX:?} of the end");
            }
        }
        let reply = self.send_window().and_then(|()| self.wait_for_first());
        let Some(reply) = reply.transpose() else {
            // A poll tells whether the chunk has arrived, and with `leaving` set takes it past the rate limiter at once. On a slow link, a
            // second copy would take too long.
            let sent = self.outgoing.iter_mut().take(self.window);
            sent.for_each(|it| it.is_kept = true);
            return Ok(self.prepare_resend());
        };
        if reply.is_ok() {
            self.silence.record_answer();
        }
        match reply {
            Ok(InsertReply::Stored {
                inserted_total,
                actors,
                waited,
            }) => {
                let was_held = self.held_since.take().is_some() || waited;
                let mut progress = lock(&self.state.progress);
                progress.inserted_total = inserted_total;
                progress.actors = actors;
                progress.is_held = was_held;
                drop(progress);
                if (sequence + 1).is_multiple_of(WINDOW_TRIAL_CHUNKS) {
                    self.window_max = (self.window_max + 1).min(self.limits.chunks_in_flight_max);
                }
                self.window = match was_held {
                    true => 1,
                    false => (self.window + 1).min(self.window_max),
                };
                self.pool.report_arrival(self.outgoing[0].in_shared_memory);
                Ok(Outcome::Stored)
            }
            Ok(InsertReply::Finished { inserted_total }) => {
                let mut progress = lock(&self.state.progress);
                progress.inserted_total = inserted_total;
                progress.is_finished = true;
                Ok(Outcome::Unwanted)
            }
            Ok(InsertReply::Wait {
                inserted_total,
                kept,
            }) => {
                lock(&self.state.progress).inserted_total = inserted_total;
                self.mark_held(kept);
                Ok(self.prepare_resend())
            }
            // The reply is from when an earlier chunk waited; all earlier chunks are stored now. A second one means that the server still
            // expects a chunk that it declined.
            Ok(InsertReply::OutOfOrder { expected }) => {
                if self.out_of_order.replace(sequence) == Some(sequence) {
                    if let Some(suppressed) = self.retry_log.admit() {
                        tracing::warn!(
                            "chunk {sequence} waits: the replay server expects {expected}{suppressed}"
                        );
                    }
                    self.pause();
                }
                Ok(self.prepare_resend())
            }
            Ok(InsertReply::Refused { why }) => bail!("the replay server rejected a chunk: {why}"),
            Err(SessionError::Recovering(recovering)) => {
                self.silence.record_answer();
                if let Some(suppressed) = self.retry_log.admit() {
                    tracing::warn!("chunk {sequence} waits: {recovering}{suppressed}");
                }
                // A poll of a few bytes instead of the same chunks again and again: its reply says when chunks are wanted.
                self.outgoing.iter_mut().for_each(|it| it.is_kept = false);
                self.outgoing[0].is_kept = true;
                self.pause();
                Ok(self.prepare_resend())
            }
            Err(e) => {
                let within = self.limits.unreachable_max;
                if self.silence.record_failure() > within {
                    let text = format!("the replay server was unreachable for {within:?}");
                    return Err(anyhow::Error::new(e).context(text));
                }
                if let Some(suppressed) = self.retry_log.admit() {
                    tracing::warn!("retrying chunk {sequence}: {e}{suppressed}");
                }
                let is_late = matches!(e, SessionError::TimedOut { .. });
                // A chunk that is late alone does not tell how many a link can take.
                if is_late && self.window > 1 {
                    self.window_max = self.window / 2;
                }
                // A chunk without a reply may not have arrived, whatever an earlier reply said. A poll at the end is just sent again: its
                // reply may come late because the chunk is still on its way.
                if !(self.outgoing[0].is_kept && self.outgoing[0].header.leaving) {
                    self.outgoing.iter_mut().for_each(|it| it.is_kept = false);
                }
                // The replay server may be unable to read shared memory: these chunks and the next ones go through the socket.
                if is_late && self.outgoing[0].in_shared_memory {
                    self.pool.report_shared_loss();
                }
                self.copy_out_of_shared_memory();
                std::thread::sleep(RETRY_PAUSE);
                Ok(self.prepare_resend())
            }
        }
    }

    /// Waits for the reply to the first chunk. Returns `None` on a shutdown of which the replay server does not know yet, and if the server
    /// may have dropped the chunk, because zenoh has written off its memory.
    fn wait_for_first(&mut self) -> Result<Option<InsertReply>, SessionError> {
        let first = &mut self.outgoing[0];
        let Some(mut reply) = first.pending.take() else {
            unreachable!("the window has room for one");
        };
        loop {
            match reply.wait_within(CHECK_INTERVAL)? {
                Some(reply) => return Ok(Some(reply)),
                None if self.shutdown.is_set() && !first.header.leaving => return Ok(None),
                None if !first.is_kept && !is_readable(&first.payload) => return Ok(None),
                None => {}
            }
        }
    }

    /// Records that the rate limiter holds the first chunk. Pauses before the retry unless the replay server keeps the chunk.
    fn mark_held(&mut self, kept: bool) {
        let since = *self.held_since.get_or_insert_with(Instant::now);
        lock(&self.state.progress).is_held = true;
        self.outgoing[0].is_kept = kept;
        if !kept {
            self.pause();
        }
        let seconds = since.elapsed().as_secs();
        if seconds >= 10
            && let Some(suppressed) = self.wait_log.admit()
        {
            tracing::info!(
                "waiting for the learner, which is behind by the replay ratio: a chunk has waited {seconds} s{suppressed}"
            );
        }
    }

    /// Pauses before the next try. Sleeps during a shutdown, when `wait_timeout` would return at once.
    fn pause(&self) {
        match self.shutdown.is_set() {
            true => std::thread::sleep(RETRY_PAUSE),
            false => _ = self.shutdown.wait_timeout(RETRY_PAUSE),
        }
    }

    fn prepare_resend(&mut self) -> Outcome {
        self.window = 1;
        self.outgoing.iter_mut().for_each(|it| it.pending = None);
        Outcome::Resend
    }

    fn copy_out_of_shared_memory(&mut self) {
        let outgoing = self.outgoing.iter_mut();
        outgoing.for_each(OutgoingChunk::copy_out_of_shared_memory);
    }

    fn send_window(&mut self) -> Result<(), SessionError> {
        let leaving = self.shutdown.is_set();
        let timeout = match leaving {
            true => self.limits.ack_timeout.min(DRAIN_ACK_TIMEOUT),
            false => self.limits.ack_timeout,
        };
        for it in self.outgoing.iter_mut().take(self.window) {
            if it.pending.is_some() {
                continue;
            }
            // A chunk that has waited here for its turn may have lost its memory meanwhile.
            if !it.is_kept && !is_readable(&it.payload) {
                it.copy_out_of_shared_memory();
            }
            let header = &mut it.header;
            header.leaving |= leaving;
            it.pending = Some(if it.is_kept {
                let poll = ChunkPoll {
                    leaving: header.leaving,
                    ..ChunkPoll::new(header.actor, header.incarnation, header.sequence)
                };
                self.client.send(self.client.encode(&poll)?, timeout)?
            } else {
                let chunk = self.client.encode_with(header, it.payload.clone())?;
                tracing::debug!(
                    "chunk {} is sent: {} transitions by weights {}",
                    header.sequence,
                    header.transitions(),
                    header.weights_version
                );
                self.client.send(chunk, timeout)?
            });
        }
        Ok(())
    }

    fn send_leave(&self, leave: Leave) {
        let (began, mut silence) = (Instant::now(), Silence::with_gap_max(2 * LEAVE_TIMEOUT));
        while let Err(e) = self.client.ask(&leave, LEAVE_TIMEOUT) {
            // The process that told the actor to stop does not wait for long.
            let may_wait = !self.shutdown.is_set() || began.elapsed() <= DRAIN_MAX;
            if may_wait && matches!(e, SessionError::Recovering(_)) {
                silence.record_answer();
            }
            if silence.record_failure() > LEAVE_RETRY_MAX {
                tracing::warn!("the replay server did not receive this actor's `Leave`: {e}");
                return;
            }
            std::thread::sleep(RETRY_PAUSE);
        }
    }
}
