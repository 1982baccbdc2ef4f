//! Keeps the newest weights: pulls each announced version from the replay server. An actor that joins late pulls at once.
//! It keeps one version alone, and the learner takes no part in a pull.

use std::{
    collections::VecDeque,
    sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError},
    time::{Duration, Instant},
};

use anyhow::anyhow;
use driml_protocol::{
    Assembly, BufferPool, CodecError, LogLimiter, PIECE_BYTES, PendingReply, RunClient, Shutdown,
    Silence, Weights, WeightsReply, WeightsRequest, WeightsVersion, fail_point, lock,
    session::SessionError,
};

/// Time-out of the request for one piece.
const PIECE_TIMEOUT: Duration = Duration::from_secs(10);
/// Pieces requested at the same time.
const PIECES_IN_FLIGHT: usize = 4;
/// How often to pull without an announcement, in case an announcement was lost.
const PULL_ANYWAY: Duration = Duration::from_secs(10);
/// How often a thread that has nothing to pull checks for shutdown.
const TICK: Duration = Duration::from_millis(200);
/// Pause between two requests for the first weights.
const PAUSE: Duration = Duration::from_millis(200);
/// How long the first weights may take before the wait is logged.
const SILENT_MAX: Duration = Duration::from_secs(5);

/// A slot for the newest weights. Each [`Self::take_within`] allows one pull; one more every [`PULL_ANYWAY`] covers lost announcements.
#[derive(Clone, Debug)]
pub(crate) struct NewestWeights {
    shared: Arc<(Mutex<State>, Condvar)>,
}

#[derive(Debug)]
struct State {
    /// The newest version that was announced.
    announced: u64,
    /// The value of `announced` when the last pull began.
    sought: u64,
    /// The version that was pulled last.
    pulled: u64,
    slot: Option<Weights>,
    /// Whether the actor has asked for weights since the last pull began.
    is_wanted: bool,
}

impl NewestWeights {
    /// An empty slot for an actor that uses the weights `version`.
    fn after(version: u64) -> Self {
        let state = State {
            announced: version,
            sought: version,
            pulled: version,
            slot: None,
            is_wanted: true,
        };
        Self {
            shared: Arc::new((Mutex::new(state), Condvar::new())),
        }
    }

    fn state(&self) -> MutexGuard<'_, State> {
        lock(&self.shared.0)
    }

    /// Takes the newest weights, if some came since the last call, and asks for newer ones. Waits up to `wait_max` for
    /// weights that were announced but not yet pulled.
    pub(crate) fn take_within(&self, wait_max: Duration) -> Option<Weights> {
        let (mut state, changed) = (self.state(), &self.shared.1);
        state.is_wanted = true;
        changed.notify_all();
        let coming = |state: &mut State| state.announced > state.pulled;
        let waited = changed.wait_timeout_while(state, wait_max, coming);
        let (mut state, _) = waited.unwrap_or_else(PoisonError::into_inner);
        state.slot.take()
    }

    fn announce(&self, version: u64) {
        let mut state = self.state();
        state.announced = state.announced.max(version);
        self.shared.1.notify_all();
    }

    /// Waits up to `wait_max` until newer weights are wanted. Returns the version that was pulled last; `None` on a time-out.
    fn wait_until_wanted(&self, wait_max: Duration) -> Option<u64> {
        let idle = |state: &mut State| !(state.is_wanted && state.announced > state.pulled);
        let changed = &self.shared.1;
        let waited = changed.wait_timeout_while(self.state(), wait_max, idle);
        let (mut state, waited) = waited.unwrap_or_else(PoisonError::into_inner);
        state.sought = state.announced;
        if waited.timed_out() {
            return None;
        }
        state.is_wanted = false;
        Some(state.pulled)
    }

    /// Stores the result of a pull; `None` if it brought no newer weights.
    fn put(&self, weights: Option<Weights>) {
        let mut state = self.state();
        match weights {
            Some(weights) => {
                state.pulled = weights.header.version;
                state.slot = Some(weights);
            }
            // The announced version does not exist: forget it, unless a later one was announced during the pull.
            None if state.announced == state.sought => state.announced = state.pulled,
            None => {}
        }
        self.shared.1.notify_all();
    }
}

/// Pulls the first weights, waiting until the learner has sent some. Returns `None` on `shutdown`.
///
/// # Errors
/// No weights within `wait_max`, not counting the time in which the replay server reads its replay back from disk.
pub(crate) fn first(
    client: &RunClient,
    wait_max: Duration,
    shutdown: &Shutdown,
) -> anyhow::Result<Option<Weights>> {
    let mut silence = Silence::with_tries_of(PIECE_TIMEOUT);
    let mut said = LogLimiter::default();
    loop {
        let pulled = pull(client, 0);
        let error = pulled.as_ref().err().and_then(|e| e.downcast_ref());
        if let Some(SessionError::Recovering(recovering)) = error {
            silence.answered();
            if recovering.progress.is_slow() && said.due().is_some() {
                tracing::info!("waiting for weights for as long as it takes: {recovering}");
            }
        }
        match pulled {
            Ok(Some(weights)) => return Ok(Some(weights)),
            pulled if silence.unanswered() > wait_max => {
                let none = format!(
                    "no weights within {wait_max:?}: is the learner running and connected to the same replay server?"
                );
                return Err(match pulled {
                    Err(e) => e.context(none),
                    Ok(_) => anyhow!(none),
                });
            }
            Err(e) => tracing::debug!("no weights yet: {e}"),
            Ok(None) => {}
        }
        if silence.length() > SILENT_MAX && said.due().is_some() {
            tracing::info!("waiting for the learner's first weights");
        }
        if shutdown.wait_timeout(PAUSE) {
            return Ok(None);
        }
    }
}

/// Starts a thread that pulls newer weights until `shutdown`; weights `version` are in use.
pub(crate) fn watch(
    client: RunClient,
    version: u64,
    shutdown: Shutdown,
) -> anyhow::Result<NewestWeights> {
    let newest = NewestWeights::after(version);
    let slot = newest.clone();
    let on_announcement = move |announced: Result<WeightsVersion, CodecError>| match announced {
        Ok(announced) => slot.announce(announced.version),
        Err(e) => tracing::warn!("an announcement of weights was dropped: {e}"),
    };
    let announcements = client
        .subscribe(on_announcement)
        .map_err(|e| anyhow!("listening for new weights: {e}"))?;
    let slot = newest.clone();
    let work = move || {
        // The subscription lasts as long as the thread.
        let _announcements = announcements;
        let mut looked = Instant::now();
        while !shutdown.is_set() {
            fail_point::reach("weights-watch");
            let wanted = slot.wait_until_wanted(TICK);
            let Some(version) = wanted.or_else(|| {
                // An announcement may have been lost.
                let look = looked.elapsed() > PULL_ANYWAY;
                look.then(|| slot.state().pulled)
            }) else {
                continue;
            };
            looked = Instant::now();
            match pull(&client, version) {
                Ok(weights) => slot.put(weights),
                // The actor is leaving and has closed its session.
                Err(_) if client.session().is_closed() => return,
                Err(e) => {
                    tracing::warn!("keeping weights {version}, newer ones did not come: {e}");
                    slot.put(None);
                }
            }
        }
    };
    std::thread::Builder::new()
        .name("weights-watch".into())
        .spawn(work)?;
    Ok(newest)
}

/// Pulls the newest weights, piece by piece. Returns `None` if they are not newer than `version`.
fn pull(client: &RunClient, version: u64) -> anyhow::Result<Option<Weights>> {
    let pool = BufferPool::new(PIECES_IN_FLIGHT);
    let first = ask(client, WeightsRequest::NewerThan(version))?;
    let (reply, piece) = first.receive(&pool)?;
    let WeightsReply::Piece {
        weights,
        bytes,
        offset,
    } = reply
    else {
        return Ok(None);
    };
    let mut assembly = Assembly::new(weights, bytes)?;
    assembly.take(weights, offset, &piece)?;
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
            asked.push_back(ask(client, request)?);
        }
        let failed = |what: &str| anyhow!("weights {} {what}", weights.version);
        let next = asked.pop_front();
        let next = next.ok_or_else(|| failed("have no last piece"))?;
        let (reply, piece) = next.receive(&pool)?;
        // Newer versions came so often that the replay server dropped this one.
        let WeightsReply::Piece {
            weights, offset, ..
        } = reply
        else {
            return Err(failed("were replaced too often while they were pulled"));
        };
        assembly.take(weights, offset, &piece)?;
    }
    Ok(Some(assembly.finish()?))
}

fn ask(client: &RunClient, request: WeightsRequest) -> anyhow::Result<PendingReply<WeightsReply>> {
    let asked = client.send(client.seal(&request)?, PIECE_TIMEOUT);
    asked.map_err(|e| anyhow!("asking for weights: {e}"))
}

#[cfg(test)]
mod tests {
    use driml_protocol::WeightsHeader;

    use super::*;

    fn weights(version: u64) -> Option<Weights> {
        Some(Weights {
            header: WeightsHeader::new(version, 0, &[]),
            safetensors: Vec::new(),
        })
    }

    #[test]
    fn weights_are_pulled_once_for_each_time_they_are_asked_for() {
        let newest = NewestWeights::after(1);
        let wanted = || newest.wait_until_wanted(Duration::ZERO);
        assert_eq!(wanted(), None, "nothing newer was announced");
        newest.announce(2);
        assert_eq!(wanted(), Some(1));
        newest.put(weights(2));
        newest.announce(3);
        assert_eq!(wanted(), None, "the last ones were not taken yet");
        assert_eq!(
            newest.take_within(Duration::ZERO).unwrap().header.version,
            2
        );
        assert_eq!(wanted(), Some(2));
        // A version that is announced during a pull, which finds nothing.
        newest.announce(1 << 60);
        newest.put(None);
        assert!(newest.take_within(Duration::ZERO).is_none());
        assert_eq!(wanted(), Some(2));
        // The announcement was false: no newer version exists, and `take_within` does not wait for one.
        newest.put(None);
        assert!(newest.take_within(Duration::from_secs(3600)).is_none());
        assert_eq!(wanted(), None);
    }

    #[test]
    fn weights_that_are_coming_are_waited_for() {
        let newest = NewestWeights::after(1);
        newest.announce(2);
        let watcher = newest.clone();
        let pull = std::thread::spawn(move || {
            while watcher.wait_until_wanted(Duration::from_secs(1)).is_none() {}
            watcher.put(weights(2));
        });
        let taken = newest.take_within(Duration::from_secs(3600));
        assert_eq!(taken.unwrap().header.version, 2);
        pull.join().unwrap();
    }
}
