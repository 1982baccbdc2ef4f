//! What the threads of the replay server share, and how they read a message, reply to it and wait for a change.
//! What each message does is in the file named for it.

use std::{
    collections::{HashMap, VecDeque},
    sync::{Arc, Condvar, Mutex, MutexGuard, OnceLock, PoisonError},
    time::{Duration, Instant},
};

use driml_protocol::{
    Announcer, BatchReply, BufferPool, CodecError, Incoming, InsertReply, LogLimiter, Recovering,
    Request, Responder, Shutdown, WeightsVersion, lock,
};

use super::{
    limits::Limits,
    parked::{ParkedChunks, ParkedRequest},
    participants::Participants,
    timings::Timings,
    weights_store::WeightsStore,
};
use crate::{persist::Reading, replay::Replay, storage::pack::Packer};

/// How long a thread sleeps when nothing is parked; it is woken when something is.
const IDLE: Duration = Duration::from_secs(60);

pub(super) struct Service {
    pub(super) limits: Limits,
    pub(super) shard: (u32, u32),
    pub(super) config_toml: String,
    pub(super) shared_memory: bool,
    /// How long a question about a chunk is held before it is answered `Wait`: far below the actors' time-out, so that an actor
    /// can tell a server that makes it wait from an unresponsive one.
    pub(super) hold_max: Duration,
    /// Memory for chunks that arrive and batches that leave.
    pub(super) pool: BufferPool,
    pub(super) packer: Packer,
    pub(super) state: Mutex<State>,
    /// Something was stored, sampled or parked: what waits for the limiter is looked at again.
    pub(super) changed: Condvar,
    pub(super) weights: Mutex<WeightsStore>,
    pub(super) announcements: Announcer<WeightsVersion>,
    pub(super) shutdown: Shutdown,
}

/// What changes, under one lock.
pub(super) struct State {
    pub(super) replay: Replay,
    pub(super) participants: Participants,
    pub(super) chunks: ParkedChunks<Question>,
    /// At most one a client: the newest attempt.
    pub(super) requests: VecDeque<ParkedRequest<Responder<BatchReply>>>,
    pub(super) timings: Timings,
    /// By their kind, lines about what was refused, which a stranger could make come at any rate.
    pub(super) said: HashMap<&'static str, LogLimiter>,
}

/// Who asks about a chunk, and since when.
pub(super) struct Question {
    pub(super) responder: Responder<InsertReply>,
    pub(super) arrived: Instant,
}

impl Service {
    pub(super) fn state(&self) -> MutexGuard<'_, State> {
        lock(&self.state)
    }

    /// Counts and logs a message that cannot be read.
    pub(super) fn refuse(&self, what: &'static str, e: &CodecError) {
        let line = format!("{what} was refused: {e}");
        self.state().refuse(what, &line);
    }

    /// Counts and logs a message that is longer than any of its kind.
    pub(super) fn refuse_long(&self, kind: &'static str, bytes: usize, bytes_max: usize) {
        let line = format!(
            "a message of {bytes} bytes to {kind:?} was refused: it has more than a message of this kind can have in this run, {bytes_max}"
        );
        self.state().refuse(kind, &line);
    }

    /// Reads a request without payload, or counts it as refused.
    pub(super) fn read<R: Request>(&self, incoming: &Incoming<R>) -> Option<R> {
        let refuse = |e: &CodecError| {
            let line = format!("a message of kind {} was refused: {e}", R::NAME);
            self.state().refuse(R::NAME, &line);
        };
        incoming.read().inspect_err(refuse).ok()
    }

    /// Answers a request without payload with what `answer` makes of it, once the lock is free again: nothing if it makes nothing.
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

    /// Waits until something has changed, or for `due_in`, after which something that is parked is due.
    pub(super) fn wait(&self, mut state: MutexGuard<'_, State>, due_in: Option<Duration>) {
        state.note_waiting(Instant::now());
        let waited = self.changed.wait_timeout(state, due_in.unwrap_or(IDLE));
        drop(waited.unwrap_or_else(PoisonError::into_inner));
    }
}

impl State {
    fn note_waiting(&mut self, now: Instant) {
        let waiting = self.replay.waiting();
        self.participants.note_waiting(waiting, now);
    }

    /// Whether a chunk or a request waits for what the replay holds; if not, the threads that serve them have nothing to look at, and
    /// what they would note is noted here. Waking them costs six changes of threads a chunk.
    pub(super) fn is_awaited(&mut self, now: Instant) -> bool {
        self.note_waiting(now);
        !self.chunks.line.is_empty() || !self.requests.is_empty()
    }

    /// Counts a message that was refused, and logs a line of this kind.
    pub(super) fn refuse(&mut self, kind: &'static str, line: &str) {
        self.replay.counted().messages_refused += 1;
        self.say(kind, line);
    }

    /// Logs a line of this kind, or counts it where one was logged a short while ago.
    pub(super) fn say(&mut self, kind: &'static str, line: &str) {
        if let Some(more) = self.said.entry(kind).or_default().due() {
            tracing::warn!("{line}{more}");
        }
    }
}

/// Admits queries to the service: until the replay is read back from disk each is answered with the progress.
pub(super) struct Admission {
    /// Set once the replay is there.
    pub(super) service: OnceLock<Arc<Service>>,
    pub(super) reading: Reading,
    pub(super) config_toml: String,
}

impl Admission {
    pub(super) fn put_off(&self) -> Recovering {
        Recovering {
            progress: self.reading.progress(),
            config_toml: self.config_toml.clone(),
        }
    }
}
