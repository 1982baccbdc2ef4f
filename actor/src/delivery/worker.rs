//! The delivering thread: sends chunks, understands the answers, sends again what did not arrive.
//! It never waits without an answer: a server that delays a chunk says so every few seconds, and an unresponsive one is
//! given up.

use std::{
    collections::VecDeque,
    sync::{Arc, mpsc},
    time::{Duration, Instant},
};

use driml_protocol::{
    Ack, BufferPool, Chunk, ChunkHeader, ChunkPoll, InsertReply, Leave, LogLimiter, PendingReply,
    RunClient, Shutdown, Silence, fail_point, session::SessionError,
};
use zenoh::bytes::ZBytes;

use super::state::{DeliveryError, DeliveryLimits, DeliveryState};

/// After `Shutdown`, how long the chunks at hand may take to be stored.
const DRAIN_MAX: Duration = Duration::from_secs(20);
/// After `Shutdown`, how long the replay server may be silent about one of them before it is sent again: several tries must fit.
const DRAIN_ACK_TIMEOUT: Duration = Duration::from_secs(4);
/// Pause between two tries when the replay server is out of reach or has no room.
const RETRY_PAUSE: Duration = Duration::from_millis(200);
/// How often a thread that waits for an answer looks whether the actor is to stop.
const TICK: Duration = Duration::from_millis(50);
/// How long `Leave` is tried, without the time in which the replay server reads its replay back.
const LEAVE_MAX: Duration = Duration::from_secs(5);
/// How long one try waits for its answer: several must fit, as a message may be lost.
const LEAVE_TRY_MAX: Duration = Duration::from_secs(1);

struct Outgoing {
    header: ChunkHeader,
    payload: ZBytes,
    in_shared_memory: bool,
    /// Set while a question about it is on its way.
    asked: Option<PendingReply<InsertReply>>,
    /// The replay server has it and will store it: a poll is enough.
    is_kept: bool,
}

/// What became of the first chunk in line.
enum Outcome {
    Stored,
    /// The run has enough transitions.
    Unwanted,
    /// It is asked about again.
    Again,
}

/// The delivering thread's state. Several chunks are on their way at once; they are settled in order, and where one has to go
/// again those after it, which the replay server then refused as out of order, go again too.
pub(super) struct DeliveryWorker {
    client: RunClient,
    limits: DeliveryLimits,
    pool: BufferPool,
    shutdown: Shutdown,
    state: Arc<DeliveryState>,
    outgoing: VecDeque<Outgoing>,
    /// Chunks that may be on their way: one after a chunk had to wait or go again, and one more with each that is stored at once.
    window: usize,
    silence: Silence,
    /// When the chunk that waits at the rate limiter began to wait.
    held_since: Option<Instant>,
    draining_since: Option<Instant>,
    retries_said: LogLimiter,
    waiting_said: LogLimiter,
}

impl DeliveryWorker {
    pub(super) fn new(
        client: RunClient,
        limits: DeliveryLimits,
        pool: BufferPool,
        shutdown: Shutdown,
        state: Arc<DeliveryState>,
    ) -> Self {
        Self {
            client,
            limits,
            pool,
            shutdown,
            state,
            outgoing: VecDeque::new(),
            window: 1,
            silence: Silence::with_tries_of(limits.ack_timeout),
            held_since: None,
            draining_since: None,
            retries_said: LogLimiter::default(),
            waiting_said: LogLimiter::default(),
        }
    }

    /// Delivers until the queue ends; gives the number of transitions that were not wanted.
    pub(super) fn run(mut self, chunks: &mpsc::Receiver<Chunk>) -> Result<u64, DeliveryError> {
        let mut last = None;
        let mut produced = 0;
        let mut unwanted = 0;
        let mut outcome = Ok(());
        while let Some(header) = self.first_in_line(chunks) {
            fail_point::reach("delivery");
            let transitions = header.transitions() as u64;
            // After a failure the rest is only counted, so that `Leave` tells the truth.
            let outcome_of_first = match outcome {
                Ok(()) => self.settle_first(),
                Err(_) => Ok(Outcome::Stored),
            };
            match outcome_of_first {
                Ok(Outcome::Again) => continue,
                Ok(Outcome::Stored) => {}
                Ok(Outcome::Unwanted) => unwanted += transitions,
                Err(e) => {
                    outcome = Err(e);
                    self.state.progress().finished = true;
                }
            }
            produced += transitions;
            last = Some((header.actor, header.incarnation));
            self.outgoing.pop_front();
            self.state.progress().waiting -= 1;
            self.state.settled.notify_all();
        }
        if let Some((actor, incarnation)) = last {
            self.leave(Leave {
                actor,
                incarnation,
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
            if self.outgoing.is_empty() {
                // While there was nothing to say, the replay server could not answer.
                self.silence.answered();
            }
            let header = chunk.header;
            let payload = chunk.into_payload();
            self.outgoing.push_back(Outgoing {
                header,
                in_shared_memory: payload.are_shared(),
                payload: payload.freeze(),
                asked: None,
                is_kept: false,
            });
        }
        if self.shutdown.is_set() {
            // Copying is cheap now, and a lost message would cost the time that is left.
            self.copy_out_of_shared_memory();
        }
        self.outgoing.front().map(|first| first.header)
    }

    /// Sends what the window allows and waits for what becomes of the first.
    fn settle_first(&mut self) -> Result<Outcome, DeliveryError> {
        let sequence = self.outgoing[0].header.sequence;
        if self.shutdown.is_set() {
            let since = *self.draining_since.get_or_insert_with(Instant::now);
            if since.elapsed() > DRAIN_MAX {
                return Err(DeliveryError::Failed(format!(
                    "chunk {sequence} was not stored within {DRAIN_MAX:?} of the end"
                )));
            }
        }
        let reply = self.send_window().and_then(|()| self.wait_for_first());
        let Some(reply) = reply.transpose() else {
            // To be let in at once, as the actor leaves.
            return Ok(self.again());
        };
        if reply.is_ok() {
            self.silence.answered();
        }
        match reply {
            Ok(InsertReply::Stored {
                inserted_total,
                actors,
                waited,
            }) => {
                let was_held = self.held_since.take().is_some() || waited;
                let mut progress = self.state.progress();
                progress.inserted_total = inserted_total;
                progress.actors = actors;
                progress.is_held = was_held;
                drop(progress);
                self.window = match was_held {
                    true => 1,
                    false => (self.window + 1).min(self.limits.chunks_in_flight_max),
                };
                if self.outgoing[0].in_shared_memory {
                    self.pool.shared_memory_works();
                }
                Ok(Outcome::Stored)
            }
            Ok(InsertReply::Finished { inserted_total }) => {
                let mut progress = self.state.progress();
                progress.inserted_total = inserted_total;
                progress.finished = true;
                Ok(Outcome::Unwanted)
            }
            Ok(InsertReply::Wait {
                inserted_total,
                kept,
            }) => {
                self.state.progress().inserted_total = inserted_total;
                self.note_held(kept);
                Ok(self.again())
            }
            // Judged while one before it waited; all of those are stored now.
            Ok(InsertReply::OutOfOrder { .. }) => Ok(self.again()),
            Ok(InsertReply::Refused { why }) => Err(DeliveryError::Failed(format!(
                "the replay server refused a chunk: {why}"
            ))),
            Err(SessionError::Recovering(recovering)) => {
                self.silence.answered();
                if let Some(more) = self.retries_said.due() {
                    tracing::warn!("chunk {sequence} waits: {recovering}{more}");
                }
                // A question of a few bytes, in the place of chunks again and again: the answer to it says that they are wanted.
                self.outgoing.iter_mut().for_each(|it| it.is_kept = false);
                self.outgoing[0].is_kept = true;
                self.pause();
                Ok(self.again())
            }
            Err(e) => {
                let within = self.limits.unreachable_max;
                if self.silence.unanswered() > within {
                    return Err(DeliveryError::OutOfReach { within, source: e });
                }
                if let Some(more) = self.retries_said.due() {
                    tracing::warn!("chunk {sequence} will be sent again: {e}{more}");
                }
                // What was not answered may not have arrived, whatever was said of it before.
                self.outgoing.iter_mut().for_each(|it| it.is_kept = false);
                // It may be unable to read shared memory: what is at hand, and the next chunks, go through the socket.
                if self.outgoing[0].in_shared_memory {
                    self.pool.avoid_shared_memory();
                }
                self.copy_out_of_shared_memory();
                std::thread::sleep(RETRY_PAUSE);
                Ok(self.again())
            }
        }
    }

    /// The answer about the first chunk; none if the actor is to leave meanwhile, which the replay server does not know yet.
    fn wait_for_first(&mut self) -> Result<Option<InsertReply>, SessionError> {
        let first = &mut self.outgoing[0];
        let Some(mut asked) = first.asked.take() else {
            unreachable!("the window has room for one");
        };
        loop {
            match asked.wait_within(TICK)? {
                Some(reply) => return Ok(Some(reply)),
                None if self.shutdown.is_set() && !first.header.leaving => return Ok(None),
                None => {}
            }
        }
    }

    /// The rate limiter makes the first chunk wait; it is asked about again at once if the replay server keeps it.
    fn note_held(&mut self, kept: bool) {
        let since = *self.held_since.get_or_insert_with(Instant::now);
        self.state.progress().is_held = true;
        self.outgoing[0].is_kept = kept;
        if !kept {
            self.pause();
        }
        let seconds = since.elapsed().as_secs();
        if seconds >= 10
            && let Some(more) = self.waiting_said.due()
        {
            tracing::info!(
                "waiting for the learner, which is behind by the replay ratio: a chunk has waited {seconds} s{more}"
            );
        }
    }

    /// Before the next try; an actor that is to leave does not ask faster for it.
    fn pause(&self) {
        match self.shutdown.is_set() {
            true => std::thread::sleep(RETRY_PAUSE),
            false => _ = self.shutdown.wait_timeout(RETRY_PAUSE),
        }
    }

    fn again(&mut self) -> Outcome {
        self.window = 1;
        self.outgoing.iter_mut().for_each(|it| it.asked = None);
        Outcome::Again
    }

    fn copy_out_of_shared_memory(&mut self) {
        for it in self.outgoing.iter_mut().filter(|it| it.in_shared_memory) {
            it.payload = ZBytes::from(it.payload.to_bytes().into_owned());
            it.in_shared_memory = false;
        }
    }

    fn send_window(&mut self) -> Result<(), SessionError> {
        let leaving = self.shutdown.is_set();
        let timeout = match leaving {
            true => self.limits.ack_timeout.min(DRAIN_ACK_TIMEOUT),
            false => self.limits.ack_timeout,
        };
        for it in self.outgoing.iter_mut().take(self.window) {
            if it.asked.is_some() {
                continue;
            }
            let header = &mut it.header;
            header.leaving |= leaving;
            it.asked = Some(if it.is_kept {
                let poll = ChunkPoll {
                    actor: header.actor,
                    incarnation: header.incarnation,
                    sequence: header.sequence,
                    leaving: header.leaving,
                };
                self.client.send(self.client.seal(&poll)?, timeout)?
            } else {
                let chunk = self.client.seal_with(header, it.payload.clone())?;
                tracing::debug!(
                    "chunk {} goes out: {} transitions by weights {}",
                    header.sequence,
                    header.transitions(),
                    header.weights_version
                );
                self.client.send(chunk, timeout)?
            });
        }
        Ok(())
    }

    fn leave(&self, leave: Leave) {
        let began = Instant::now();
        let mut silent_since = began;
        loop {
            let e = match self.client.ask(&leave, LEAVE_TRY_MAX) {
                Ok(Ack) => return,
                Err(e) => e,
            };
            // The process that told the actor to stop does not wait for long.
            let may_wait = !self.shutdown.is_set() || began.elapsed() <= DRAIN_MAX;
            if may_wait && matches!(e, SessionError::Recovering(_)) {
                silent_since = Instant::now();
            }
            if silent_since.elapsed() > LEAVE_MAX {
                tracing::warn!("the replay server did not receive this actor's `Leave`: {e}");
                return;
            }
            std::thread::sleep(RETRY_PAUSE);
        }
    }
}
