//! Keeps the newest weights at hand: hears of a new version, then pulls it; a late joiner pulls at once.
//! It keeps one set alone, and it never makes the learner wait.

use std::{
    sync::{Arc, Mutex, PoisonError},
    time::{Duration, Instant},
};

use anyhow::Context;
use driml_protocol::{Keys, Kind, Shutdown, WeightsHeader, WeightsVersion, codec, session};
use zenoh::{Session, Wait, bytes::ZBytes, handlers::RingChannel, qos::Priority};

/// One pull of a few megabytes.
const PULL_TIMEOUT: Duration = Duration::from_secs(10);
/// How often to look for a new version although none was announced, in case the announcement was lost.
const PULL_ANYWAY: Duration = Duration::from_secs(10);
/// How long to sleep between looks for an announcement.
const TICK: Duration = Duration::from_millis(20);

/// Weights as they came: what they say of themselves, and a safetensors file.
pub(crate) type Weights = (WeightsHeader, Vec<u8>);

/// The newest weights, taken at most once.
#[derive(Clone, Debug, Default)]
pub(crate) struct Newest {
    slot: Arc<Mutex<Option<Weights>>>,
}

impl Newest {
    /// Takes the newest weights, if they came since the last call.
    pub(crate) fn take(&self) -> Option<Weights> {
        self.slot
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
            .take()
    }

    fn put(&self, weights: Weights) {
        *self.slot.lock().unwrap_or_else(PoisonError::into_inner) = Some(weights);
    }
}

/// Pulls the first weights, waiting until the learner has some; `None` if told to stop before.
///
/// # Errors
/// No learner within `wait_max`.
pub(crate) fn first_weights(
    session: &Session,
    keys: &Keys,
    spec_hash: u64,
    wait_max: Duration,
    shutdown: &Shutdown,
) -> anyhow::Result<Option<Weights>> {
    let started = Instant::now();
    loop {
        match pull(session, keys, spec_hash) {
            Ok(weights) => return Ok(Some(weights)),
            Err(e) if started.elapsed() > wait_max => {
                return Err(e).context(format!(
                    "no weights within {wait_max:?}: is the learner running and connected to the same replay server?"
                ));
            }
            Err(e) => tracing::debug!("no weights yet: {e:#}"),
        }
        if shutdown.wait_timeout(Duration::from_millis(200)) {
            return Ok(None);
        }
    }
}

/// Watches until `shutdown`, on a thread of its own.
///
/// # Errors
/// No subscription, or no thread.
pub(crate) fn watch(
    session: Session,
    keys: Keys,
    spec_hash: u64,
    mut version: u64,
    shutdown: Shutdown,
) -> anyhow::Result<Newest> {
    let newest = Newest::default();
    let slot = newest.clone();
    let announced = session
        .declare_subscriber(keys.weights_version())
        .with(RingChannel::new(1))
        .wait()
        .map_err(|e| anyhow::anyhow!("listening for new weights: {e}"))?;
    let work = move || {
        let mut pulled = Instant::now();
        while !shutdown.wait_timeout(TICK) {
            let newer = match announced.try_recv() {
                Ok(Some(sample)) => {
                    match codec::decode::<WeightsVersion>(
                        &sample.payload().to_bytes(),
                        Kind::WeightsVersion,
                        Some(spec_hash),
                    ) {
                        Ok((announced, _)) => announced.version > version,
                        Err(e) => {
                            tracing::warn!("an announcement of weights was dropped: {e}");
                            false
                        }
                    }
                }
                _ => pulled.elapsed() > PULL_ANYWAY,
            };
            if !newer {
                continue;
            }
            pulled = Instant::now();
            match pull(&session, &keys, spec_hash) {
                Ok(weights) if weights.0.version > version => {
                    version = weights.0.version;
                    slot.put(weights);
                }
                Ok(_) => {}
                // The actor leaves: its session closes under this thread.
                Err(_) if session.is_closed() => return,
                Err(e) => {
                    tracing::warn!("keeping weights {version}, newer ones did not come: {e:#}")
                }
            }
        }
    };
    std::thread::Builder::new()
        .name("weight-watch".into())
        .spawn(work)?;
    Ok(newest)
}

fn pull(session: &Session, keys: &Keys, spec_hash: u64) -> anyhow::Result<Weights> {
    let bytes = session::ask(
        session,
        &keys.weights(),
        ZBytes::new(),
        Priority::DataLow,
        PULL_TIMEOUT,
    )?;
    let bytes = bytes.to_bytes();
    let (header, planes) = WeightsHeader::decode(&bytes, spec_hash)?;
    Ok((header, planes.to_vec()))
}
