//! Keeps the newest weights at hand: hears of a new version, then pulls it from the replay server; a late joiner pulls at once.
//! It keeps one set alone, and the learner has no part in a pull.

use std::{
    collections::VecDeque,
    sync::{Arc, Mutex, PoisonError},
    time::{Duration, Instant},
};

use anyhow::{Context, bail};
use driml_protocol::{
    Keys, Kind, Shutdown, WeightsHeader, WeightsReply, WeightsRequest, WeightsVersion, codec,
    fault,
    seldom::Seldom,
    session::{self, Asked},
    weights::{Assembly, PIECE_BYTES},
};
use zenoh::{Session, Wait, bytes::ZBytes, handlers::RingChannel, qos::Priority};

/// One piece.
const PIECE_TIMEOUT: Duration = Duration::from_secs(10);
/// Pieces on their way at once.
const PIECES_IN_FLIGHT: usize = 4;
/// How often to look for a new version although none was announced, in case the announcement was lost.
const PULL_ANYWAY: Duration = Duration::from_secs(10);
/// How long to sleep between looks for an announcement.
const TICK: Duration = Duration::from_millis(20);
/// Pause between two questions for the first weights.
const PAUSE: Duration = Duration::from_millis(200);
/// How long the first weights may take before a person hears that they are waited for.
const SILENT_MAX: Duration = Duration::from_secs(5);

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

/// Where weights come from.
#[derive(Clone, Debug)]
pub(crate) struct WeightsSource {
    pub(crate) session: Session,
    pub(crate) keys: Keys,
    pub(crate) spec_hash: u64,
}

impl WeightsSource {
    /// Pulls the first weights, waiting until the learner has sent some; `None` if told to stop before.
    ///
    /// # Errors
    /// No weights within `wait_max`.
    pub(crate) fn first(
        &self,
        wait_max: Duration,
        shutdown: &Shutdown,
    ) -> anyhow::Result<Option<Weights>> {
        let started = Instant::now();
        let mut said = Seldom::default();
        loop {
            let pulled = self.pull(0);
            match pulled {
                Ok(Some(weights)) => return Ok(Some(weights)),
                pulled if started.elapsed() > wait_max => {
                    let advice = format!(
                        "no weights within {wait_max:?}: is the learner running and connected to the same replay server?"
                    );
                    return match pulled {
                        Err(e) => Err(e.context(advice)),
                        Ok(_) => bail!(advice),
                    };
                }
                Err(e) => tracing::debug!("no weights yet: {e:#}"),
                Ok(None) => {}
            }
            if started.elapsed() > SILENT_MAX && said.due().is_some() {
                tracing::info!("waiting for the learner's first weights");
            }
            if shutdown.wait_timeout(PAUSE) {
                return Ok(None);
            }
        }
    }

    /// Watches until `shutdown`, on a thread of its own.
    ///
    /// # Errors
    /// No subscription, or no thread.
    pub(crate) fn watch(self, version: u64, shutdown: Shutdown) -> anyhow::Result<Newest> {
        let newest = Newest::default();
        let slot = newest.clone();
        let announced = self
            .session
            .declare_subscriber(self.keys.weights_version())
            .with(RingChannel::new(1))
            .wait()
            .map_err(|e| anyhow::anyhow!("listening for new weights: {e}"))?;
        let work = move || {
            let (mut version, mut pulled) = (version, Instant::now());
            while !shutdown.wait_timeout(TICK) {
                fault::point("weights-watch");
                let newer = match announced.try_recv() {
                    Ok(Some(sample)) => self.is_newer(&sample.payload().to_bytes(), version),
                    _ => pulled.elapsed() > PULL_ANYWAY,
                };
                if !newer {
                    continue;
                }
                pulled = Instant::now();
                match self.pull(version) {
                    Ok(Some(weights)) => {
                        version = weights.0.version;
                        slot.put(weights);
                    }
                    Ok(None) => {}
                    // The actor leaves: its session closes under this thread.
                    Err(_) if self.session.is_closed() => return,
                    Err(e) => {
                        tracing::warn!("keeping weights {version}, newer ones did not come: {e:#}");
                    }
                }
            }
        };
        std::thread::Builder::new()
            .name("weights-watch".into())
            .spawn(work)?;
        Ok(newest)
    }

    fn is_newer(&self, announcement: &[u8], version: u64) -> bool {
        let kind = Kind::WeightsVersion;
        match codec::decode::<WeightsVersion>(announcement, kind, Some(self.spec_hash)) {
            Ok((announced, _)) => announced.version > version,
            Err(e) => {
                tracing::warn!("an announcement of weights was dropped: {e}");
                false
            }
        }
    }

    /// The newest weights, piece by piece; none if they are not newer than `version`.
    fn pull(&self, version: u64) -> anyhow::Result<Option<Weights>> {
        let first = self.ask(WeightsRequest::NewerThan(version))?;
        let answer = first.answer()?;
        let answer = answer.to_bytes();
        let (reply, piece) = self.read(&answer)?;
        let WeightsReply::Piece {
            weights,
            bytes,
            offset,
        } = reply
        else {
            return Ok(None);
        };
        let mut assembly = Assembly::new(weights, bytes)?;
        assembly.take(weights, offset, piece)?;
        let offsets = (assembly.next_offset()..assembly.bytes()).step_by(PIECE_BYTES);
        let mut requests = offsets.map(|offset| WeightsRequest::Piece {
            version: weights.version,
            offset,
        });
        let mut asked = VecDeque::new();
        while !assembly.is_whole() {
            while asked.len() < PIECES_IN_FLIGHT
                && let Some(request) = requests.next()
            {
                asked.push_back(self.ask(request)?);
            }
            let Some(next) = asked.pop_front() else {
                bail!("weights {} have no last piece", weights.version);
            };
            let answer = next.answer()?;
            let answer = answer.to_bytes();
            match self.read(&answer)? {
                (
                    WeightsReply::Piece {
                        weights, offset, ..
                    },
                    piece,
                ) => assembly.take(weights, offset, piece)?,
                _ => bail!(
                    "weights {} were replaced too often while they were pulled",
                    weights.version
                ),
            }
        }
        Ok(Some(assembly.finish()?))
    }

    fn ask(&self, request: WeightsRequest) -> anyhow::Result<Asked> {
        let message = codec::encode(Kind::WeightsRequest, self.spec_hash, &request, &[])?;
        session::send(
            &self.session,
            &self.keys.weights(),
            ZBytes::from(message),
            Priority::DataLow,
            PIECE_TIMEOUT,
        )
        .context("asking for weights")
    }

    fn read<'a>(&self, answer: &'a [u8]) -> anyhow::Result<(WeightsReply, &'a [u8])> {
        Ok(codec::decode(answer, Kind::Weights, Some(self.spec_hash))?)
    }
}
