//! Keeps the newest weights: pulls each announced version from the replay server. An actor that joins late pulls at once.
//! It keeps one version alone, and the learner takes no part in a pull.

use std::{
    collections::VecDeque,
    sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError},
    time::{Duration, Instant},
};

use anyhow::anyhow;
use driml_protocol::{
    Buffer, BufferPool, CodecError, LogLimiter, PIECE_BYTES, RunClient, Shutdown, Silence, Weights,
    WeightsReply, WeightsRequest, WeightsVersion, codec::PAYLOAD_BYTES_MAX, fail_point, lock,
    session::SessionError, spawn,
};

/// Time-out of the request for one piece, once those before it have arrived.
const PIECE_TIMEOUT: Duration = Duration::from_secs(10);
/// Pieces requested at the same time.
const PIECES_IN_FLIGHT_MAX: usize = 4;
/// How often to pull without an announcement, in case an announcement was lost.
const PULL_INTERVAL_MAX: Duration = Duration::from_secs(10);
/// How often a thread that has nothing to pull checks for shutdown.
const SHUTDOWN_CHECK_INTERVAL: Duration = Duration::from_millis(200);
/// Pause between two requests for the first weights.
const RETRY_PAUSE: Duration = Duration::from_millis(200);
/// How long the first weights may take before the wait is logged.
const UNLOGGED_WAIT_MAX: Duration = Duration::from_secs(5);

/// A slot for the newest weights. Each [`Self::take_within`] allows one pull; one more every [`PULL_INTERVAL_MAX`] covers lost messages.
#[derive(Clone, Debug)]
pub(crate) struct NewestWeights {
    shared: Arc<(Mutex<State>, Condvar)>,
}

#[derive(Debug)]
struct State {
    /// The newest version that was announced.
    announced: u64,
    /// The value of `announced` when the last pull began.
    announced_at_pull: u64,
    /// The version that was pulled last.
    pulled: u64,
    slot: Option<Weights>,
    /// Whether the actor has asked for weights since the last pull began.
    is_wanted: bool,
}

impl NewestWeights {
    /// An empty slot for an actor that uses the weights `version`.
    fn newer_than(version: u64) -> Self {
        let state = State {
            announced: version,
            announced_at_pull: version,
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
        let is_coming = |state: &mut State| state.announced > state.pulled;
        let waited = changed.wait_timeout_while(state, wait_max, is_coming);
        let (mut state, _) = waited.unwrap_or_else(PoisonError::into_inner);
        state.slot.take()
    }

    fn record_announcement(&self, version: u64) {
        let mut state = self.state();
        state.announced = state.announced.max(version);
        self.shared.1.notify_all();
    }

    /// Waits up to `wait_max` until newer weights are wanted. Returns the version that was pulled last; `None` on a time-out.
    fn wait_until_wanted(&self, wait_max: Duration) -> Option<u64> {
        let is_idle = |state: &mut State| !(state.is_wanted && state.announced > state.pulled);
        let changed = &self.shared.1;
        let waited = changed.wait_timeout_while(self.state(), wait_max, is_idle);
        let (mut state, waited) = waited.unwrap_or_else(PoisonError::into_inner);
        state.announced_at_pull = state.announced;
        if waited.timed_out() {
            return None;
        }
        state.is_wanted = false;
        Some(state.pulled)
    }

    /// Stores the result of a pull; `None` if it brought no newer weights.
    fn finish_pull(&self, weights: Option<Weights>) {
        let mut state = self.state();
        match weights {
            Some(weights) => {
                state.pulled = weights.header.version;
                state.slot = Some(weights);
            }
            // The announced version does not exist: forget it, unless a later one was announced during the pull.
            None if state.announced == state.announced_at_pull => state.announced = state.pulled,
            None => {}
        }
        self.shared.1.notify_all();
    }
}

/// Pulls the first weights, waiting until the learner has sent some. Returns `None` on `shutdown`.
///
/// # Errors
/// No weights within `wait_max`, not counting the time in which the replay server reads its replay back from disk.
pub(crate) fn wait_for_first(
    client: &RunClient,
    wait_max: Duration,
    shutdown: &Shutdown,
) -> anyhow::Result<Option<Weights>> {
    let mut silence = Silence::with_try_timeout(PIECE_TIMEOUT);
    let mut log_limiter = LogLimiter::default();
    let pool = BufferPool::new(PIECES_IN_FLIGHT_MAX);
    loop {
        let (from, buffers) = (client.clone(), pool.clone());
        // A frozen replay server does not keep the actor from exiting.
        let send = move |request, timeout| send(&from, &buffers, request, timeout);
        let first = move || pull(0, send);
        let Some(pulled) = shutdown.run_unless_set("first-weights", first, || false)? else {
            return Ok(None);
        };
        let error = pulled.as_ref().err().and_then(|e| e.downcast_ref());
        if let Some(SessionError::Recovering(recovering)) = error {
            silence.record_answer();
            if recovering.progress.is_slow() && log_limiter.admit().is_some() {
                tracing::info!("waiting for weights for as long as it takes: {recovering}");
            }
        }
        match pulled {
            Ok(Some(weights)) => return Ok(Some(weights)),
            pulled if silence.record_failure() > wait_max => {
                let message = format!(
                    "no weights within {wait_max:?}: is the learner running and connected to the same replay server?"
                );
                return Err(match pulled {
                    Err(e) => e.context(message),
                    Ok(_) => anyhow!(message),
                });
            }
            Err(e) => tracing::debug!("no weights yet: {e}"),
            Ok(None) => {}
        }
        if silence.length() > UNLOGGED_WAIT_MAX && log_limiter.admit().is_some() {
            tracing::info!("waiting for the learner's first weights");
        }
        if shutdown.wait_timeout(RETRY_PAUSE) {
            return Ok(None);
        }
    }
}

/// Starts a thread that pulls newer weights until `shutdown`; weights `version` are in use.
pub(crate) fn start_puller(
    client: RunClient,
    version: u64,
    shutdown: Shutdown,
) -> anyhow::Result<NewestWeights> {
    let newest = NewestWeights::newer_than(version);
    let slot = newest.clone();
    let on_announcement = move |announced: Result<WeightsVersion, CodecError>| match announced {
        Ok(announced) => slot.record_announcement(announced.version),
        Err(e) => tracing::warn!("an announcement of weights was dropped: {e}"),
    };
    let announcements = client
        .subscribe(on_announcement)
        .map_err(|e| anyhow!("listening for new weights: {e}"))?;
    let slot = newest.clone();
    let pull_loop = move || {
        // The subscription lasts as long as the thread.
        let _announcements = announcements;
        let mut last_pull = Instant::now();
        let pool = BufferPool::new(PIECES_IN_FLIGHT_MAX);
        while !shutdown.is_set() {
            fail_point::reach("weights-watch");
            let wanted = slot.wait_until_wanted(SHUTDOWN_CHECK_INTERVAL);
            let Some(version) = wanted.or_else(|| {
                // An announcement may have been lost.
                let is_due = last_pull.elapsed() > PULL_INTERVAL_MAX;
                is_due.then(|| slot.state().pulled)
            }) else {
                continue;
            };
            last_pull = Instant::now();
            let send = |request, timeout| send(&client, &pool, request, timeout);
            match pull(version, send) {
                Ok(weights) => slot.finish_pull(weights),
                // The actor is leaving and has closed its session.
                Err(_) if client.session().is_closed() => return,
                Err(e) => {
                    tracing::warn!("keeping weights {version}, newer ones did not arrive: {e}");
                    slot.finish_pull(None);
                }
            }
        }
    };
    spawn("weights-watch", pull_loop)?;
    Ok(newest)
}

/// Pulls the newest weights, piece by piece. `send` requests a piece, with a time-out, and returns a function that waits for the reply.
/// Returns `None` if the weights are not newer than `version`.
fn pull<R>(
    version: u64,
    send: impl Fn(WeightsRequest, Duration) -> anyhow::Result<R>,
) -> anyhow::Result<Option<Weights>>
where
    R: FnOnce() -> Result<(WeightsReply, Buffer), SessionError>,
{
    let (reply, first) = send(WeightsRequest::NewerThan(version), PIECE_TIMEOUT)?()?;
    let WeightsReply::Piece {
        weights: header,
        bytes,
        ..
    } = reply
    else {
        return Ok(None);
    };
    let version = header.version;
    let error = |what: &str| Err(anyhow!("weights {version} {what}"));
    if bytes > PAYLOAD_BYTES_MAX as u64 {
        return error("are larger than a message may be");
    }
    let offsets = (PIECE_BYTES as u64..bytes).step_by(PIECE_BYTES);
    let mut requests = offsets.map(|offset| WeightsRequest::Piece { version, offset });
    let (mut safetensors, mut pending) = (first.to_vec(), VecDeque::new());
    loop {
        while pending.len() < PIECES_IN_FLIGHT_MAX
            && let Some(request) = requests.next()
        {
            // On a slow link, a piece also waits for those before it.
            let ahead = pending.len() as u32;
            pending.push_back(send(request, PIECE_TIMEOUT * (ahead + 1))?);
        }
        let Some(receive) = pending.pop_front() else {
            break;
        };
        let (reply, piece) = receive()?;
        // Newer versions came so often that the replay server dropped this one.
        if !matches!(reply, WeightsReply::Piece { .. }) {
            return error("were replaced too often while they were pulled");
        }
        if (safetensors.len() + piece.len()) as u64 > bytes {
            return error("have more bytes than their first piece says");
        }
        safetensors.extend_from_slice(&piece);
    }
    // Any wrong, missing or misplaced piece changes the hash.
    header.check_hash(&safetensors)?;
    Ok(Some(Weights {
        header,
        safetensors,
    }))
}

/// Requests a piece. The returned function waits for the reply, and takes memory for it from `pool`.
fn send(
    client: &RunClient,
    pool: &BufferPool,
    request: WeightsRequest,
    timeout: Duration,
) -> anyhow::Result<impl FnOnce() -> Result<(WeightsReply, Buffer), SessionError> + use<>> {
    let sent = client.send(client.encode(&request)?, timeout);
    let sent = sent.map_err(|e| anyhow!("requesting weights: {e}"))?;
    let pool = pool.clone();
    Ok(move || sent.receive(&pool))
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
        let newest = NewestWeights::newer_than(1);
        let wanted = || newest.wait_until_wanted(Duration::ZERO);
        assert_eq!(wanted(), None, "nothing newer was announced");
        newest.record_announcement(2);
        assert_eq!(wanted(), Some(1));
        newest.finish_pull(weights(2));
        newest.record_announcement(3);
        assert_eq!(wanted(), None, "the last ones were not taken yet");
        let taken = newest.take_within(Duration::ZERO);
        assert_eq!(taken.unwrap().header.version, 2);
        assert_eq!(wanted(), Some(2));
        // A version that is announced during a pull, which finds nothing.
        newest.record_announcement(1 << 60);
        newest.finish_pull(None);
        assert!(newest.take_within(Duration::ZERO).is_none());
        assert_eq!(wanted(), Some(2));
        // The announcement was false: no newer version exists, and `take_within` does not wait for one.
        newest.finish_pull(None);
        assert!(newest.take_within(Duration::from_secs(3600)).is_none());
        assert_eq!(wanted(), None);
    }

    #[test]
    fn weights_that_are_coming_are_waited_for() {
        let newest = NewestWeights::newer_than(1);
        newest.record_announcement(2);
        let watcher = newest.clone();
        let pull = std::thread::spawn(move || {
            while watcher.wait_until_wanted(Duration::from_secs(1)).is_none() {}
            watcher.finish_pull(weights(2));
        });
        let taken = newest.take_within(Duration::from_secs(3600));
        assert_eq!(taken.unwrap().header.version, 2);
        pull.join().unwrap();
    }

    #[test]
    fn pieces_make_the_whole_in_their_order_alone() {
        let file: Vec<u8> = (0..6 * PIECE_BYTES + 10).map(|i| (i % 251) as u8).collect();
        let header = WeightsHeader::new(3, 7, &file);
        // Pulls from a replay server that serves `served` in place of the piece at `wrong`.
        let pulled = |wrong: usize, served: &[u8]| {
            pull(2, |request, _| {
                let offset = match request {
                    WeightsRequest::NewerThan(_) => 0,
                    WeightsRequest::Piece { offset, .. } => offset,
                };
                let rest = &file[offset as usize..];
                let piece = match offset == wrong as u64 {
                    true => served,
                    false => &rest[..rest.len().min(PIECE_BYTES)],
                };
                let piece = Buffer::from(piece.to_vec());
                let reply = WeightsReply::Piece {
                    weights: header,
                    bytes: file.len() as u64,
                    offset,
                };
                Ok(move || Ok((reply, piece)))
            })
        };
        let whole = pulled(usize::MAX, &[]).unwrap().unwrap();
        assert_eq!((whole.header, &whole.safetensors), (header, &file));
        let (first, second) = file.split_at(PIECE_BYTES);
        for (wrong, served) in [
            (0, &first[1..]),
            (PIECE_BYTES, first),
            (0, &[]),
            (0, second),
        ] {
            assert!(pulled(wrong, served).is_err(), "{wrong}");
        }
    }
}
