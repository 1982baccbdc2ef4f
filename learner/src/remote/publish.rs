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
    Ack, AffinityUpdate, CodecError, EncodedMessage, Incoming, LearnerStatus, LogLimiter,
    PriorityUpdate, Request, RunClient, Sampling, Shutdown, Weights, WeightsUpload, answer_queries,
    codec::PAYLOAD_BYTES_MAX, fail_point, lock, session::SessionError, spawn,
};
use zenoh::query::Queryable;

/// Time-out of sending affinity or priorities. Weights have a longer one.
const SEND_TIMEOUT: Duration = Duration::from_secs(5);
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
    pub(crate) learner_id: u64,
    status: Arc<Mutex<LearnerStatus>>,
    status_sent: Arc<AtomicBool>,
    weights: Arc<Outbox<Weights>>,
    pub(crate) affinity: Arc<Outbox<AffinityUpdate>>,
    /// The priorities of the rows of one update each. They are sent in order, each until every shard has acknowledged it.
    pub(crate) priorities: Arc<Outbox<PriorityUpdate>>,
    _queryables: Vec<Queryable<()>>,
}

/// A bounded queue of values to send, oldest first. If it is full, a new value replaces the oldest.
pub(crate) struct Outbox<T> {
    waiting: Mutex<VecDeque<T>>,
    capacity: usize,
    not_empty: Condvar,
    /// Whether no value waits or is being sent.
    idle: AtomicBool,
    /// Number of values that all replay servers have acknowledged.
    pub(crate) acknowledged: AtomicU64,
}

impl<T> Outbox<T> {
    fn new(capacity: usize) -> Arc<Self> {
        Arc::new(Self {
            waiting: Mutex::default(),
            capacity,
            not_empty: Condvar::new(),
            idle: true.into(),
            acknowledged: AtomicU64::default(),
        })
    }

    /// Queues a value. If the queue is full, the oldest value is dropped.
    pub(crate) fn push(&self, value: T) {
        let mut waiting = lock(&self.waiting);
        if waiting.len() == self.capacity {
            waiting.pop_front();
        }
        waiting.push_back(value);
        self.idle.store(false, Ordering::Relaxed);
        drop(waiting);
        self.not_empty.notify_one();
    }

    /// Takes the oldest value, and waits for one up to [`TICK`]. A call means that the value taken before has been sent.
    fn take(&self) -> Option<T> {
        let waiting = lock(&self.waiting);
        self.idle.store(waiting.is_empty(), Ordering::Relaxed);
        let (mut waiting, _) = self
            .not_empty
            .wait_timeout_while(waiting, TICK, |waiting| waiting.is_empty())
            .unwrap_or_else(PoisonError::into_inner);
        waiting.pop_front()
    }

    /// Whether the next value would replace the oldest.
    fn is_full(&self) -> bool {
        lock(&self.waiting).len() == self.capacity
    }
}

impl Publisher {
    /// Declares the status in every session, and starts the threads that send weights, affinity and priorities for `learner_id`.
    pub(crate) fn start(
        clients: &[RunClient],
        spec_hash: u64,
        learner_id: u64,
        sampling: &Sampling,
        shutdown: &Shutdown,
    ) -> anyhow::Result<Self> {
        let status: Arc<Mutex<LearnerStatus>> = Arc::default();
        let status_sent: Arc<AtomicBool> = Arc::default();
        let (replied_status, sent) = (status.clone(), status_sent.clone());
        let reply_status = move |incoming: Incoming<LearnerStatus>| {
            let status = lock(&replied_status).clone();
            incoming.into_responder().reply(&status);
            sent.store(status.finished, Ordering::Relaxed);
        };
        let mut queryables = Vec::new();
        for client in clients {
            let (name, answer) = ("learner-status", reply_status.clone());
            let declared = answer_queries(client, name, 1, PAYLOAD_BYTES_MAX, answer, |_| ());
            let error = |e| anyhow::anyhow!("declaring the learner's status: {e}");
            queryables.push(declared.map_err(error)?.0);
        }
        let this = Self {
            learner_id,
            status,
            status_sent,
            weights: Outbox::new(1),
            affinity: Outbox::new(1),
            priorities: Outbox::new(PRIORITIES_MAX),
            _queryables: queryables,
        };
        let outbox_sender = |what, timeout| OutboxSender {
            what,
            clients: clients.to_vec(),
            timeout,
            shutdown: shutdown.clone(),
            log_limiter: LogLimiter::default(),
        };
        let weights = outbox_sender("weights", WEIGHTS_TIMEOUT);
        weights.start(this.weights.clone(), move |weights| {
            let upload = WeightsUpload {
                learner: learner_id,
                weights: weights.header,
            };
            EncodedMessage::with_payload(&upload, weights.safetensors.clone().into(), spec_hash)
        })?;
        let affinity = outbox_sender("affinity", SEND_TIMEOUT);
        affinity.start(this.affinity.clone(), move |update| {
            EncodedMessage::new(update, spec_hash)
        })?;
        if sampling.is_prioritised() {
            let priorities = outbox_sender("priorities", SEND_TIMEOUT);
            priorities.start(this.priorities.clone(), move |update| {
                EncodedMessage::new(update, spec_hash)
            })?;
        }
        Ok(this)
    }

    /// Queues the weights for the replay servers, which announce them and give them to actors. Replaces weights that were not sent
    /// yet.
    pub(crate) fn publish(&self, weights: Weights) {
        let (version, updates) = (weights.header.version, weights.header.updates);
        let mut status = lock(&self.status);
        status.weights_version = version;
        status.weights_sha256 = weights.header.sha256_hex();
        drop(status);
        tracing::debug!("weights {version} are published, after {updates} updates");
        self.weights.push(weights);
    }

    /// Waits until the status was fetched once after the learner finished and its last weights were sent, for at most `wait_max`. After
    /// `shutdown`, it waits for the status alone, as nothing more is sent.
    pub(crate) fn wait_until_fetched(&self, wait_max: Duration, shutdown: &Shutdown) {
        let start = Instant::now();
        let idle = || shutdown.is_set() || self.weights.idle.load(Ordering::Relaxed);
        while !(self.status_sent.load(Ordering::Relaxed) && idle()) && start.elapsed() < wait_max {
            std::thread::sleep(Duration::from_millis(20));
        }
    }

    pub(crate) fn update_status(&self, change: impl FnOnce(&mut LearnerStatus)) {
        change(&mut lock(&self.status));
    }
}

/// Sends values of one kind to all replay servers. Retries until each has acknowledged a value, or the queue of newer values is full.
struct OutboxSender {
    what: &'static str,
    clients: Vec<RunClient>,
    timeout: Duration,
    shutdown: Shutdown,
    log_limiter: LogLimiter,
}

impl OutboxSender {
    /// Starts a thread that sends until the shutdown; `message` encodes a value.
    fn start<T: Send + 'static, R: Request<Reply = Ack>>(
        mut self,
        outbox: Arc<Outbox<T>>,
        message: impl Fn(&T) -> Result<EncodedMessage<R>, CodecError> + Send + 'static,
    ) -> std::io::Result<()> {
        let name = format!("{}-sender", self.what);
        spawn(name.clone(), move || {
            while !self.shutdown.is_set() {
                fail_point::reach(&name);
                let Some(value) = outbox.take() else { continue };
                match message(&value) {
                    Ok(message) => {
                        if self.send_to_all(&message, || outbox.is_full()) {
                            outbox.acknowledged.fetch_add(1, Ordering::Relaxed);
                        }
                    }
                    Err(e) => tracing::error!("the {} cannot be sent: {e}", self.what),
                }
            }
        })?;
        Ok(())
    }

    /// Sends `message` to all replay servers, with retries while `is_superseded` is false. Returns whether all have acknowledged it.
    fn send_to_all<R: Request<Reply = Ack>>(
        &mut self,
        message: &EncodedMessage<R>,
        is_superseded: impl Fn() -> bool,
    ) -> bool {
        let mut arrived = true;
        for client in &self.clients {
            let send = || client.send(message.clone(), self.timeout)?.wait();
            while let Err(e) = send() {
                let pause = match e {
                    SessionError::Recovering(_) => RECOVERY_PAUSE,
                    _ => RETRY_PAUSE,
                };
                if is_superseded() || self.shutdown.wait_timeout(pause) {
                    arrived = false;
                    break;
                }
                if let Some(more) = self.log_limiter.admit() {
                    tracing::warn!("the {} did not arrive, retrying: {e}{more}", self.what);
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
        let outbox = Outbox::new(1);
        let idle = || outbox.idle.load(Ordering::Relaxed);
        assert!(idle());
        outbox.push(1);
        outbox.push(2);
        assert!(!idle());
        assert_eq!(outbox.take(), Some(2));
        assert!(!idle(), "it is being sent");
        assert_eq!(outbox.take(), None);
        assert!(idle());
    }
}
