//! Publishes a learner's weights, affinity and priorities to the replay servers, and its status on request.
//! No update waits for any of this.

use std::{
    collections::VecDeque,
    sync::{
        Arc, Condvar, Mutex, PoisonError,
        atomic::{AtomicBool, AtomicU64, Ordering},
    },
    time::{Duration, Instant},
};

use driml_protocol::{
    Ack, AffinityUpdate, CodecError, Incoming, LearnerStatus, LogLimiter, PriorityUpdate,
    QueryWorkers, Request, RunClient, Sampling, Sealed, Shutdown, Weights, WeightsUpload,
    codec::PAYLOAD_BYTES_MAX, fail_point, lock, session::SessionError,
};
use zenoh::query::Queryable;

/// Time-out of sending affinity or priorities. Weights have a longer one.
const TIMEOUT: Duration = Duration::from_secs(5);
const WEIGHTS_TIMEOUT: Duration = Duration::from_secs(10);
/// Largest number of updates whose priorities wait to be sent, more than batches can be in flight: a replay server that sends batches
/// also receives priorities. Beyond this, the oldest are dropped, and their transitions keep the priorities that they have.
const PRIORITIES_MAX: usize = 128;
/// Pause before a retry.
const RETRY_PAUSE: Duration = Duration::from_millis(200);
/// Pause before a retry while the replay server recovers its replay from disk; longer, as weights are megabytes.
const RECOVERY_PAUSE: Duration = Duration::from_secs(2);
/// How often a thread that has nothing to send checks whether it should end.
const TICK: Duration = Duration::from_millis(200);

/// The learner's publisher. Dropping it ends the replies to status requests; a shutdown ends its threads.
pub(crate) struct Publisher {
    /// The number by which the replay server knows this learner.
    pub(crate) learner: u64,
    status: Arc<Mutex<LearnerStatus>>,
    fetched: Arc<AtomicBool>,
    weights: Arc<Outbox<Weights>>,
    pub(crate) affinity: Arc<Outbox<AffinityUpdate>>,
    /// The priorities of the rows of one update each. They are sent in order, each until every shard has acknowledged it.
    pub(crate) priorities: Arc<Outbox<PriorityUpdate>>,
    _queryables: Vec<Queryable<()>>,
}

/// A bounded queue of values to send, oldest first. If it is full, a new value replaces the oldest.
pub(crate) struct Outbox<T> {
    waiting: Mutex<VecDeque<T>>,
    most: usize,
    filled: Condvar,
    /// Whether no value waits or is being sent.
    idle: AtomicBool,
    /// Number of values that all replay servers have acknowledged.
    pub(crate) arrived: AtomicU64,
}

impl<T> Outbox<T> {
    fn of(most: usize) -> Arc<Self> {
        Arc::new(Self {
            waiting: Mutex::default(),
            most,
            filled: Condvar::new(),
            idle: true.into(),
            arrived: AtomicU64::default(),
        })
    }

    /// Queues a value. If the queue is full, the oldest value is dropped.
    pub(crate) fn put(&self, value: T) {
        let mut waiting = lock(&self.waiting);
        if waiting.len() == self.most {
            waiting.pop_front();
        }
        waiting.push_back(value);
        self.idle.store(false, Ordering::Relaxed);
        drop(waiting);
        self.filled.notify_one();
    }

    /// Takes the oldest value, and waits for one up to [`TICK`]. A call means that the value taken before has been sent.
    fn take(&self) -> Option<T> {
        let waiting = lock(&self.waiting);
        self.idle.store(waiting.is_empty(), Ordering::Relaxed);
        let (mut waiting, _) = self
            .filled
            .wait_timeout_while(waiting, TICK, |waiting| waiting.is_empty())
            .unwrap_or_else(PoisonError::into_inner);
        waiting.pop_front()
    }

    /// Whether the next value would replace the oldest.
    fn is_full(&self) -> bool {
        lock(&self.waiting).len() == self.most
    }
}

impl Publisher {
    /// Declares the status in every session, and starts the threads that send weights, affinity and priorities for `learner`.
    pub(crate) fn open(
        clients: &[RunClient],
        spec_hash: u64,
        learner: u64,
        sampling: &Sampling,
        shutdown: &Shutdown,
    ) -> anyhow::Result<Self> {
        let status: Arc<Mutex<LearnerStatus>> = Arc::default();
        let fetched: Arc<AtomicBool> = Arc::default();
        let (held, told) = (status.clone(), fetched.clone());
        let give = move |incoming: Incoming<LearnerStatus>| {
            let status = lock(&held).clone();
            incoming.into_responder().reply(&status);
            told.store(status.finished, Ordering::Relaxed);
        };
        let status_asked = QueryWorkers::start("learner-status", 1, spec_hash, give)?;
        let mut queryables = Vec::new();
        for client in clients {
            let declared = status_asked.declare(client, PAYLOAD_BYTES_MAX, |_| ());
            queryables.push(
                declared.map_err(|e| anyhow::anyhow!("declaring the learner's status: {e}"))?,
            );
        }
        let this = Self {
            learner,
            status,
            fetched,
            weights: Outbox::of(1),
            affinity: Outbox::of(1),
            priorities: Outbox::of(PRIORITIES_MAX),
            _queryables: queryables,
        };
        let to_all = |what, timeout| Sender {
            what,
            clients: clients.to_vec(),
            timeout,
            shutdown: shutdown.clone(),
            said: LogLimiter::default(),
        };
        let weights = to_all("weights", WEIGHTS_TIMEOUT);
        weights.start(this.weights.clone(), move |weights| {
            let upload = WeightsUpload {
                learner,
                weights: weights.header,
            };
            Sealed::with_payload(&upload, weights.safetensors.clone().into(), spec_hash)
        })?;
        let affinity = to_all("affinity", TIMEOUT);
        affinity.start(this.affinity.clone(), move |update| {
            Sealed::new(update, spec_hash)
        })?;
        if sampling.is_prioritised() {
            let priorities = to_all("priorities", TIMEOUT);
            priorities.start(this.priorities.clone(), move |update| {
                Sealed::new(update, spec_hash)
            })?;
        }
        Ok(this)
    }

    /// Queues the weights for the replay servers, which announce them and give them to actors. Replaces weights that were not sent
    /// yet.
    pub(crate) fn publish(&self, weights: Weights) {
        let mut status = lock(&self.status);
        status.weights_version = weights.header.version;
        status.weights_sha256 = weights.header.sha256_hex();
        drop(status);
        tracing::debug!(
            "weights {} are published, after {} updates",
            weights.header.version,
            weights.header.updates
        );
        self.weights.put(weights);
    }

    /// Waits until the status was fetched once after the learner finished and its last weights were sent, for at most `wait_max`. After
    /// `shutdown`, it waits for the status alone, as nothing more is sent.
    pub(crate) fn wait_until_heard(&self, wait_max: Duration, shutdown: &Shutdown) {
        let started = Instant::now();
        let idle = || shutdown.is_set() || self.weights.idle.load(Ordering::Relaxed);
        while !(self.fetched.load(Ordering::Relaxed) && idle()) && started.elapsed() < wait_max {
            std::thread::sleep(Duration::from_millis(20));
        }
    }

    pub(crate) fn with_status(&self, change: impl FnOnce(&mut LearnerStatus)) {
        change(&mut lock(&self.status));
    }
}

/// Sends values of one kind to all replay servers. Retries until each has acknowledged a value, or the queue of newer values is full.
struct Sender {
    what: &'static str,
    clients: Vec<RunClient>,
    timeout: Duration,
    shutdown: Shutdown,
    said: LogLimiter,
}

impl Sender {
    /// Starts a thread that sends until the shutdown; `message` encodes a value.
    fn start<T: Send + 'static, R: Request<Reply = Ack>>(
        mut self,
        newest: Arc<Outbox<T>>,
        message: impl Fn(&T) -> Result<Sealed<R>, CodecError> + Send + 'static,
    ) -> std::io::Result<()> {
        let name = format!("{}-sender", self.what);
        let thread = std::thread::Builder::new().name(name.clone());
        thread.spawn(move || {
            while !self.shutdown.is_set() {
                fail_point::reach(&name);
                let Some(value) = newest.take() else { continue };
                match message(&value) {
                    Ok(message) => {
                        if self.send_to_all(&message, || newest.is_full()) {
                            newest.arrived.fetch_add(1, Ordering::Relaxed);
                        }
                    }
                    Err(e) => tracing::error!("the {} cannot be sent: {e}", self.what),
                }
            }
        })?;
        Ok(())
    }

    /// Sends `message` to all replay servers, with retries while `is_old` is false. Returns whether all have acknowledged it.
    fn send_to_all<R: Request<Reply = Ack>>(
        &mut self,
        message: &Sealed<R>,
        is_old: impl Fn() -> bool,
    ) -> bool {
        let mut arrived = true;
        for client in &self.clients {
            let send = || client.send(message.clone(), self.timeout)?.wait();
            while let Err(e) = send() {
                let pause = match e {
                    SessionError::Recovering(_) => RECOVERY_PAUSE,
                    _ => RETRY_PAUSE,
                };
                if is_old() || self.shutdown.wait_timeout(pause) {
                    arrived = false;
                    break;
                }
                if let Some(more) = self.said.due() {
                    tracing::warn!("the {} did not arrive, trying again: {e}{more}", self.what);
                }
            }
        }
        arrived
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_waits_or_is_being_sent_is_not_sent() {
        let newest = Outbox::of(1);
        let idle = || newest.idle.load(Ordering::Relaxed);
        assert!(idle());
        newest.put(1);
        newest.put(2);
        assert!(!idle());
        assert_eq!(newest.take(), Some(2));
        assert!(!idle(), "it is being sent");
        assert_eq!(newest.take(), None);
        assert!(idle());
    }
}
