//! Joining a run: fetching its settings, and registering as an actor or as the learner.
//! Serving a run and leaving it are up to each process.

use std::{fmt, time::Duration};

use zenoh::{Session, bytes::ZBytes};

use crate::{
    client::RunClient,
    messages::join::{JoinReply, RunInfo, Welcome},
    process::{log_limiter::LogLimiter, shutdown::Shutdown, silence::Silence},
    session::{self, SessionError},
    wire::{
        keys::Keys,
        message::{Keyed, Request},
    },
};

/// How long a joining process waits for a replay server.
const SERVER_WAIT_MAX: Duration = Duration::from_secs(60);
/// How long it waits until its predecessor is disconnected: a session that was cut off counts as connected for its lease of 30 s.
const PREDECESSOR_WAIT_MAX: Duration = Duration::from_secs(45);
/// How long it waits before it logs that it is waiting.
const QUIET_WAIT_MAX: Duration = Duration::from_secs(5);
/// How long one try waits for its reply.
const TRY_TIMEOUT: Duration = Duration::from_secs(2);
const PAUSE: Duration = Duration::from_millis(200);

/// Why a process could not join a run.
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
pub struct JoinError(String);

/// Fetches the run's settings from the replay server. Waits up to 60 s for the server to start, and without a limit while the server reads
/// its replay back from disk. Returns `None` if `shutdown` is set first.
///
/// # Errors
/// No replay server answered within 60 s, or its reply cannot be read, for example because its protocol version differs.
pub fn fetch_run_info(
    session: &Session,
    keys: &Keys,
    shutdown: &Shutdown,
) -> Result<Option<RunInfo>, JoinError> {
    let mut server_wait = ServerWait::default();
    loop {
        match fetch_run_info_once(session, keys, TRY_TIMEOUT) {
            Ok(run_info) => return Ok(Some(run_info)),
            Err(e) => server_wait.record_failure(e)?,
        }
        if shutdown.wait_timeout(PAUSE) {
            return Ok(None);
        }
    }
}

/// Asks the replay server once for the run's settings, and waits for at most `wait_max`.
pub fn fetch_run_info_once(
    session: &Session,
    keys: &Keys,
    wait_max: Duration,
) -> Result<RunInfo, SessionError> {
    let (key, nothing) = (keys.key::<RunInfo>(), ZBytes::new());
    session::send::<RunInfo>(session, key, nothing, RunInfo::PRIORITY, wait_max, None)?.wait()
}

/// How long a joining process waits for its replay server, and what it logs meanwhile.
#[derive(Default)]
struct ServerWait {
    silence: Silence,
    silence_log: LogLimiter,
    wait_log: LogLimiter,
}

impl ServerWait {
    /// Records the answer of a server that needs time, and logs now and then `why`, if the user `should_know`.
    fn record_wait(&mut self, should_know: bool, why: &impl fmt::Display) {
        self.silence.record_answer();
        if should_know && self.wait_log.admit().is_some() {
            tracing::info!("waiting for as long as it takes: {why}");
        }
    }

    /// Records a failed attempt, and logs now and then what this process waits for. Returns an error if a retry is useless.
    fn record_failure(&mut self, e: SessionError) -> Result<(), JoinError> {
        let e = match e {
            SessionError::Unreadable { why, .. } => {
                let what = "reading the replay server's run info";
                return Err(JoinError(format!("{what}: {why}")));
            }
            SessionError::Recovering(recovering) => {
                self.record_wait(recovering.progress.is_slow(), &recovering);
                return Ok(());
            }
            e => e,
        };
        let since = self.silence.record_failure();
        if since > SERVER_WAIT_MAX {
            let max = SERVER_WAIT_MAX.as_secs();
            return Err(JoinError(format!(
                "no replay server answered within {max} s: is it running, and is the endpoint right? ({e})"
            )));
        }
        if since > QUIET_WAIT_MAX && self.silence_log.admit().is_some() {
            let (since, max) = (since.as_secs(), SERVER_WAIT_MAX.as_secs());
            // The listener may be a router to which the replay server has not connected yet.
            let why = match e {
                SessionError::NoResponder { key } => format!(
                    "a process listens there, but does not answer at {key}: is it the replay server of this run, with the same --namespace?"
                ),
                other => other.to_string(),
            };
            tracing::info!(
                "waiting for the replay server for {since} s so far (at most {max} s): {why}"
            );
        }
        Ok(())
    }
}

/// Registers this process as an actor or as the run's learner; returns `None` if `shutdown` is set first.
///
/// # Errors
/// Another process keeps this role, or the replay server rejects this one or does not answer for a minute.
pub fn join(
    client: &RunClient,
    request: &impl Request<Reply = JoinReply>,
    shutdown: &Shutdown,
) -> Result<Option<Welcome>, JoinError> {
    let mut server_wait = ServerWait::default();
    let mut predecessor: Option<Silence> = None;
    loop {
        match client.ask(request, TRY_TIMEOUT) {
            Ok(JoinReply::Welcome(welcome)) => return Ok(Some(welcome)),
            Ok(JoinReply::Refused { why }) => {
                let why = format!("the replay server rejects this process: {why}");
                return Err(JoinError(why));
            }
            Ok(JoinReply::Wait { why }) => server_wait.record_wait(true, &why),
            Ok(JoinReply::Taken { why }) => match &mut predecessor {
                Some(silence) => {
                    if silence.record_failure() > PREDECESSOR_WAIT_MAX {
                        let seconds = PREDECESSOR_WAIT_MAX.as_secs();
                        let why = format!("{why}; it has not exited within {seconds} s");
                        return Err(JoinError(why));
                    }
                }
                None => {
                    let max = PREDECESSOR_WAIT_MAX.as_secs();
                    tracing::warn!("{why}; waiting up to {max} s until the other process exits");
                    predecessor = Some(Silence::default());
                }
            },
            Err(e) => server_wait.record_failure(e)?,
        }
        if shutdown.wait_timeout(PAUSE) {
            return Ok(None);
        }
    }
}
