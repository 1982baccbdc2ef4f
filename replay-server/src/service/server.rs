//! The state that the threads of the replay server share, and how they read a message, reply to it and wait for a change.
//! The file named after a message handles it.

use std::{
    collections::{HashMap, VecDeque},
    fmt::Display,
    sync::{Arc, Condvar, Mutex, MutexGuard, OnceLock, PoisonError},
    time::{Duration, Instant},
};

use driml_protocol::{
    BatchReply, BufferPool, CodecError, Incoming, InsertReply, LogLimiter, Request, Responder,
    RunClient, Shutdown, lock,
};

use super::{
    limits::MessageLimits,
    parked::{ParkedChunks, ParkedRequest},
    participants::Participants,
    timings::Timings,
    weights_store::WeightsStore,
};
use crate::{persist::RecoveryControl, replay::Replay, storage::pack::Packer};

/// How long a thread sleeps when nothing is parked; it is woken when something is.
const IDLE_MAX: Duration = Duration::from_secs(60);
/// A longer time without access to the state means that this process was stopped: one thread accesses the state every second.
const STOP_MIN: Duration = Duration::from_secs(15);

pub(super) struct Service {
    pub(super) limits: MessageLimits,
    pub(super) shard: (u32, u32),
    pub(super) config_toml: String,
    pub(super) reads_shared_memory: bool,
    /// How long a query about a chunk is held before the reply `Wait`: far below the actors' time-out, so that an actor can tell a server
    /// that makes it wait from an unresponsive one.
    pub(super) hold_max: Duration,
    /// Memory for chunks that arrive and batches that leave.
    pub(super) pool: BufferPool,
    pub(super) packer: Packer,
    pub(super) state: Mutex<State>,
    /// Signalled when something was stored, sampled or parked: threads then check the parked chunks and requests again.
    pub(super) changed: Condvar,
    pub(super) weights: Mutex<WeightsStore>,
    pub(super) client: RunClient,
    pub(super) shutdown: Shutdown,
}

/// The mutable state, under one lock.
pub(super) struct State {
    pub(super) replay: Replay,
    pub(super) participants: Participants,
    pub(super) chunks: ParkedChunks<PendingQuery>,
    /// The parked requests, at most one per client: the newest attempt.
    pub(super) requests: VecDeque<ParkedRequest<Responder<BatchReply>>>,
    pub(super) timings: Timings,
    /// Rate limiters for log lines about rejected messages, by kind. Without them a foreign process could fill the log.
    pub(super) log_limiters: HashMap<&'static str, LogLimiter>,
    last_access: Instant,
}

/// A query about a chunk that was not answered yet.
pub(super) struct PendingQuery {
    pub(super) responder: Responder<InsertReply>,
    pub(super) arrived: Instant,
}

impl Service {
    pub(super) fn state(&self) -> MutexGuard<'_, State> {
        let mut state = lock(&self.state);
        state.leave_out_stop(Instant::now());
        state
    }

    /// Counts and logs a message of kind `R` that cannot be read.
    pub(super) fn reject_unreadable<R: Request>(&self, e: &CodecError) {
        self.state().reject(R::NAME, e);
    }

    /// Reads a request without payload. If that fails, counts and logs the message as rejected.
    pub(super) fn read<R: Request>(&self, incoming: &Incoming<R>) -> Option<R> {
        let reject = |e: &CodecError| self.reject_unreadable::<R>(e);
        incoming.read().inspect_err(reject).ok()
    }

    /// Answers a request without payload with the reply that `answer` returns, after unlocking the state. `None` sends no reply.
    pub(super) fn answer<R: Request>(
        &self,
        incoming: Incoming<R>,
        answer: impl FnOnce(&mut State, R) -> Option<R::Reply>,
    ) {
        let Some(request) = self.read(&incoming) else {
            return;
        };
        let reply = answer(&mut self.state(), request);
        if let Some(reply) = reply {
            incoming.into_responder().reply(&reply);
        }
    }

    /// Waits until something has changed, or for `due_in`, the time until a parked item is due; not after the shutdown.
    pub(super) fn wait_changed(&self, mut state: MutexGuard<'_, State>, due_in: Option<Duration>) {
        state.update_waiting(Instant::now());
        if !self.shutdown.is_set() {
            let waited = self.changed.wait_timeout(state, due_in.unwrap_or(IDLE_MAX));
            drop(waited.unwrap_or_else(PoisonError::into_inner));
        }
    }
}

impl State {
    pub(super) fn new(replay: Replay, now: Instant) -> Self {
        Self {
            replay,
            participants: Participants::new(now),
            chunks: ParkedChunks::new(),
            requests: VecDeque::new(),
            timings: Timings::default(),
            log_limiters: HashMap::new(),
            last_access: now,
        }
    }

    /// If this process was stopped until `now`, moves the beginnings of all waits by that time, so that it does not count as waiting.
    fn leave_out_stop(&mut self, now: Instant) {
        let stop = now.saturating_duration_since(std::mem::replace(&mut self.last_access, now));
        if stop < STOP_MIN {
            return;
        }
        for parked in &mut self.chunks.queue {
            parked.arrived += stop;
            parked.queried_at += stop;
            parked.query.iter_mut().for_each(|it| it.arrived += stop);
        }
        self.requests.iter_mut().for_each(|it| it.arrived += stop);
        self.timings.leave_out_stop(stop);
    }

    fn update_waiting(&mut self, now: Instant) {
        let waiting = self.replay.waiting();
        self.participants.set_waiting(waiting, now);
    }

    /// Whether a chunk or a request is parked. If not, the threads that serve them need not wake, which saves six context switches per
    /// chunk. Notes which side waits, as those threads would do.
    pub(super) fn has_parked(&mut self, now: Instant) -> bool {
        self.update_waiting(now);
        !self.chunks.queue.is_empty() || !self.requests.is_empty()
    }

    /// Counts a rejected message of this kind, and logs the reason.
    pub(super) fn reject(&mut self, kind: &'static str, why: &impl Display) {
        self.replay.counters_mut().messages_refused += 1;
        let line = format!("a message of kind {kind} was rejected: {why}");
        self.warn_limited(kind, &line);
    }

    /// Logs a line of this kind, or only counts it if one was logged recently.
    pub(super) fn warn_limited(&mut self, kind: &'static str, line: &str) {
        if let Some(more) = self.log_limiters.entry(kind).or_default().admit() {
            tracing::warn!("{line}{more}");
        }
    }
}

/// Passes queries to the service. Until the replay is read back from disk, each query is answered with the progress.
pub(super) struct ServiceGate {
    /// Set once the replay has been read back.
    pub(super) service: OnceLock<Arc<Service>>,
    pub(super) recovery: RecoveryControl,
    pub(super) config_toml: String,
}

#[cfg(test)]
mod tests {
    use driml_protocol::{ActorJoin, RunSpec};

    use super::*;
    use crate::config::Config;
    use crate::service::parked::{ParkedChunk, tests::chunk};

    #[test]
    fn the_time_in_which_the_process_was_stopped_is_no_waiting() {
        let (begin, second, stop) = (Instant::now(), Duration::from_secs(1), 240 * STOP_MIN);
        let mut replay = Replay::new(&RunSpec::smallest(), &Config::unlimited(9), 1).unwrap();
        replay.join_actor(ActorJoin::new(0, 9)).unwrap();
        let mut state = State::new(replay, begin);
        state.chunks.queue.push_back(ParkedChunk {
            packed: chunk(0, 0, 1),
            query: None,
            arrived: begin,
            queried_at: begin,
        });
        state.leave_out_stop(begin + second);
        state.leave_out_stop(begin + second + stop);
        state.store_parked(begin + 2 * second + stop);
        assert_eq!(state.replay.status().actors_waited_s, 2.0);
    }
}
