//! What the learner publishes: each version of its weights and of its affinity to the replay server, its status on request.
//! No update waits for any of it.

use std::{
    sync::{
        Arc, Condvar, Mutex, MutexGuard, PoisonError,
        atomic::{AtomicBool, Ordering},
    },
    time::{Duration, Instant},
};

use driml_protocol::{
    AffinityUpdate, CodecError, Done, LearnerStatus, QueryWorkers, Request, Responder, RunClient,
    Sealed, Seldom, Shutdown, Weights, WeightsUpload, fault,
};
use zenoh::query::Queryable;

/// One delivery of the affinity matrix.
const AFFINITY_TIMEOUT: Duration = Duration::from_secs(5);
/// One delivery of weights.
const WEIGHTS_TIMEOUT: Duration = Duration::from_secs(10);
/// Pause between two tries.
const RETRY_PAUSE: Duration = Duration::from_millis(200);
/// How often a thread that has nothing to send looks whether it should end.
const TICK: Duration = Duration::from_millis(200);

/// The learner's outlets; dropping it closes them.
pub(crate) struct Outlets {
    learner: u64,
    status: Arc<Mutex<LearnerStatus>>,
    heard: Arc<AtomicBool>,
    weights: Arc<Newest<Weights>>,
    affinity: Arc<Newest<AffinityUpdate>>,
    _queryables: Vec<Queryable<()>>,
}

/// A slot that keeps the newest of its kind until it is sent.
struct Newest<T> {
    slot: Mutex<Option<T>>,
    filled: Condvar,
}

impl<T> Default for Newest<T> {
    fn default() -> Self {
        Self {
            slot: Mutex::default(),
            filled: Condvar::new(),
        }
    }
}

impl<T> Newest<T> {
    fn put(&self, value: T) {
        *lock(&self.slot) = Some(value);
        self.filled.notify_one();
    }

    /// Takes what is there, waiting for it for a while.
    fn take(&self) -> Option<T> {
        let slot = lock(&self.slot);
        let (mut slot, _) = self
            .filled
            .wait_timeout_while(slot, TICK, |slot| slot.is_none())
            .unwrap_or_else(PoisonError::into_inner);
        slot.take()
    }

    fn is_filled(&self) -> bool {
        lock(&self.slot).is_some()
    }
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Outlets {
    /// Declares the status in every session, and starts the threads that send weights and affinity as those of `learner`.
    pub(crate) fn open(
        clients: &[RunClient],
        spec_hash: u64,
        learner: u64,
        shutdown: &Shutdown,
    ) -> anyhow::Result<Self> {
        let status: Arc<Mutex<LearnerStatus>> = Arc::default();
        let heard: Arc<AtomicBool> = Arc::default();
        let (held, told) = (status.clone(), heard.clone());
        let give = move |responder: Responder<LearnerStatus>| {
            let status = lock(&held).clone();
            responder.reply(&status);
            told.store(status.finished, Ordering::Relaxed);
        };
        let status_asked = QueryWorkers::offer("learner-status", 1, spec_hash, give)?;
        let mut queryables = Vec::new();
        for client in clients {
            let declared = status_asked.declare(client);
            queryables.push(
                declared.map_err(|e| anyhow::anyhow!("declaring the learner's status: {e}"))?,
            );
        }
        let this = Self {
            learner,
            status,
            heard,
            weights: Arc::default(),
            affinity: Arc::default(),
            _queryables: queryables,
        };
        let to_all = |what, timeout| Sender {
            what,
            clients: clients.to_vec(),
            timeout,
            shutdown: shutdown.clone(),
            said: Seldom::default(),
        };
        let weights = to_all("weights", WEIGHTS_TIMEOUT);
        weights.start(this.weights.clone(), move |weights| {
            let upload = WeightsUpload {
                learner,
                weights: weights.header,
            };
            Sealed::with_payload(&upload, weights.safetensors.clone().into(), spec_hash)
        })?;
        let affinity = to_all("affinity", AFFINITY_TIMEOUT);
        affinity.start(this.affinity.clone(), move |update| {
            Sealed::new(update, spec_hash)
        })?;
        Ok(this)
    }

    /// The number by which the replay server knows this learner.
    pub(crate) const fn learner(&self) -> u64 {
        self.learner
    }

    /// Hands the weights over to the replay server, which announces them and gives them to actors; those that were not sent yet
    /// are replaced.
    pub(crate) fn publish(&self, weights: Weights) {
        let mut status = lock(&self.status);
        status.weights_version = weights.header.version;
        status.weights_sha256 = weights.header.sha256_hex();
        drop(status);
        self.weights.put(weights);
    }

    /// Hands over the newest affinity; one that was not sent yet is replaced.
    pub(crate) fn send_affinity(&self, update: AffinityUpdate) {
        self.affinity.put(update);
    }

    /// Waits until somebody has asked for the status since the learner finished, or for `wait_max`.
    pub(crate) fn wait_until_heard(&self, wait_max: Duration) {
        let started = Instant::now();
        while !self.heard.load(Ordering::Relaxed) && started.elapsed() < wait_max {
            std::thread::sleep(Duration::from_millis(20));
        }
    }

    /// Changes the status that others see.
    pub(crate) fn with_status(&self, change: impl FnOnce(&mut LearnerStatus)) {
        change(&mut lock(&self.status));
    }
}

/// Sends the newest of its kind to all replay servers, again until each has said that it has it or something newer is there.
struct Sender {
    what: &'static str,
    clients: Vec<RunClient>,
    timeout: Duration,
    shutdown: Shutdown,
    said: Seldom,
}

impl Sender {
    /// Starts a thread that sends until the shutdown; `message` makes the bytes of what is sent.
    fn start<T: Send + 'static, R: Request<Reply = Done>>(
        mut self,
        newest: Arc<Newest<T>>,
        message: impl Fn(&T) -> Result<Sealed<R>, CodecError> + Send + 'static,
    ) -> std::io::Result<()> {
        let name = format!("{}-sender", self.what);
        let thread = std::thread::Builder::new().name(name.clone());
        thread.spawn(move || {
            while !self.shutdown.is_set() {
                fault::point(&name);
                let Some(value) = newest.take() else { continue };
                match message(&value) {
                    Ok(message) => self.send_to_all(&message, || newest.is_filled()),
                    Err(e) => tracing::error!("the {} cannot be sent: {e}", self.what),
                }
            }
        })?;
        Ok(())
    }

    fn send_to_all<R: Request<Reply = Done>>(
        &mut self,
        message: &Sealed<R>,
        is_old: impl Fn() -> bool,
    ) {
        for client in &self.clients {
            let send = || client.send(message.clone(), self.timeout)?.wait();
            while let Err(e) = send() {
                if is_old() || self.shutdown.wait_timeout(RETRY_PAUSE) {
                    break;
                }
                if let Some(more) = self.said.due() {
                    tracing::warn!("the {} did not arrive, trying again: {e}{more}", self.what);
                }
            }
        }
    }
}
