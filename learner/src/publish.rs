//! What the learner tells others: its newest weights on demand, that they are new, its affinity, its own status.
//! It computes none of it.

use std::{
    sync::{
        Arc, Condvar, Mutex, MutexGuard, PoisonError,
        atomic::{AtomicBool, Ordering},
    },
    time::{Duration, Instant},
};

use driml_protocol::{
    AffinityUpdate, Keys, Kind, LearnerStatus, Shutdown, WeightsVersion, answering::Answering,
    codec, session,
};
use zenoh::{
    Session, Wait,
    bytes::ZBytes,
    pubsub::Publisher,
    qos::{CongestionControl, Priority},
    query::Queryable,
};

use crate::learning::Weights;

/// One delivery of the affinity matrix.
const AFFINITY_TIMEOUT: Duration = Duration::from_secs(5);

/// The learner's outlets; dropping it closes them.
pub(crate) struct Outlets {
    weights: Arc<Mutex<Option<ZBytes>>>,
    status: Arc<Mutex<LearnerStatus>>,
    heard: Arc<AtomicBool>,
    affinity: Arc<Newest>,
    versions: Vec<Publisher<'static>>,
    spec_hash: u64,
    _queryables: Vec<Queryable<()>>,
}

/// A slot that keeps the newest affinity until it is sent.
#[derive(Default)]
struct Newest {
    slot: Mutex<Option<AffinityUpdate>>,
    filled: Condvar,
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Outlets {
    /// Declares everything that others may ask, in every session, and starts the affinity's own thread.
    pub(crate) fn open(
        sessions: &[Session],
        keys: &Keys,
        spec_hash: u64,
        shutdown: &Shutdown,
    ) -> anyhow::Result<Self> {
        let failed = |e: zenoh::Error| anyhow::anyhow!("declaring what the learner answers: {e}");
        let weights: Arc<Mutex<Option<ZBytes>>> = Arc::default();
        let status: Arc<Mutex<LearnerStatus>> = Arc::default();
        let heard: Arc<AtomicBool> = Arc::default();
        let held = weights.clone();
        let weights_asked = Answering::start("weights", 1, move |query| {
            // An actor that comes before the first weights hears nothing and asks again.
            let message = lock(&held).clone();
            if let Some(message) = message {
                session::answer(query, message);
            }
        })?;
        let (held, told) = (status.clone(), heard.clone());
        let status_asked = Answering::start("status", 1, move |query| {
            let status = lock(&held).clone();
            match codec::encode(Kind::LearnerStatus, spec_hash, &status, &[]) {
                Ok(bytes) => {
                    session::answer(query, bytes.into());
                    told.store(status.finished, Ordering::Relaxed);
                }
                Err(e) => tracing::warn!("the learner's status was not sent: {e}"),
            }
        })?;
        let (mut versions, mut queryables) = (Vec::new(), Vec::new());
        for session in sessions {
            let weights = weights_asked.declare(session, keys.weights());
            let status = status_asked.declare(session, keys.learner_status());
            queryables.extend([weights.map_err(failed)?, status.map_err(failed)?]);
            // An announcement that is dropped under congestion is made good by the next, or by the actors' own look.
            let publisher = session
                .declare_publisher(keys.weights_version())
                .congestion_control(CongestionControl::Drop)
                .priority(Priority::InteractiveHigh);
            versions.push(publisher.wait().map_err(failed)?);
        }
        let affinity = Arc::new(Newest::default());
        let sender = AffinitySender {
            sessions: sessions.to_vec(),
            key: keys.affinity(),
            spec_hash,
            newest: affinity.clone(),
            shutdown: shutdown.clone(),
        };
        std::thread::Builder::new()
            .name("affinity".into())
            .spawn(move || sender.run())?;
        Ok(Self {
            weights,
            status,
            heard,
            affinity,
            versions,
            spec_hash,
            _queryables: queryables,
        })
    }

    /// Makes `weights` the ones that actors get, and announces them.
    pub(crate) fn publish(&self, (header, safetensors): Weights) -> anyhow::Result<()> {
        let head = codec::seal(Kind::Weights, self.spec_hash, &header, &safetensors)?;
        *lock(&self.weights) = Some(session::join_planes(head, safetensors.into()));
        let announced = WeightsVersion {
            version: header.version,
        };
        let bytes = codec::encode(Kind::WeightsVersion, self.spec_hash, &announced, &[])?;
        for version in &self.versions {
            if let Err(e) = version.put(bytes.clone()).wait() {
                tracing::warn!("weights {} were not announced: {e}", header.version);
            }
        }
        let mut status = lock(&self.status);
        status.weights_version = header.version;
        status.weights_sha256 = header.sha256_hex();
        Ok(())
    }

    /// Hands over the newest affinity; one that was not sent yet is replaced.
    pub(crate) fn send_affinity(&self, update: AffinityUpdate) {
        *lock(&self.affinity.slot) = Some(update);
        self.affinity.filled.notify_one();
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

struct AffinitySender {
    sessions: Vec<Session>,
    key: String,
    spec_hash: u64,
    newest: Arc<Newest>,
    shutdown: Shutdown,
}

impl AffinitySender {
    fn run(self) {
        while !self.shutdown.is_set() {
            let slot = lock(&self.newest.slot);
            let (mut slot, _) = self
                .newest
                .filled
                .wait_timeout_while(slot, Duration::from_millis(200), |slot| slot.is_none())
                .unwrap_or_else(PoisonError::into_inner);
            let Some(update) = slot.take() else { continue };
            drop(slot);
            for session in &self.sessions {
                if let Err(e) = self.send(session, &update) {
                    tracing::warn!(
                        "affinity {} did not arrive, the next one will: {e:#}",
                        update.version
                    );
                }
            }
        }
    }

    fn send(&self, session: &Session, update: &AffinityUpdate) -> anyhow::Result<()> {
        let bytes = codec::encode(Kind::Affinity, self.spec_hash, update, &[])?;
        let payload = ZBytes::from(bytes);
        let answer = session::ask(
            session,
            &self.key,
            payload,
            Priority::DataHigh,
            AFFINITY_TIMEOUT,
        )?;
        codec::decode::<()>(&answer.to_bytes(), Kind::Done, Some(self.spec_hash))?;
        Ok(())
    }
}
