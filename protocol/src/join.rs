//! Joining a run: fetching its settings, and taking part in it as an actor or as the learner.
//! It does not serve or leave the run; each process does that itself.

use std::time::Duration;

use zenoh::{Session, bytes::ZBytes};

use crate::{
    client::RunClient,
    messages::join::{JoinReply, RunInfo, Welcome},
    process::{log_limiter::LogLimiter, shutdown::Shutdown, silence::Silence},
    session::{self, SessionError},
    wire::{
        codec,
        error::CodecError,
        keys::Keys,
        message::{Keyed, Request},
    },
};

/// How long a joining process waits for a replay server.
const SERVER_MAX: Duration = Duration::from_secs(60);
/// How long it waits for its predecessor to be gone: a session that was cut off counts as connected for its lease of 30 s.
const TAKEN_MAX: Duration = Duration::from_secs(45);
/// How long it waits before it says so.
const SILENT_MAX: Duration = Duration::from_secs(5);
/// How long one try waits for its reply.
const TRY_MAX: Duration = Duration::from_secs(2);
const PAUSE: Duration = Duration::from_millis(200);

/// Why a process could not join a run.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs, reason = "each message says it")]
pub enum JoinError {
    #[error("no replay server answered within {} s: is it running, and is the endpoint right? ({last})", SERVER_MAX.as_secs())]
    NoReplayServer { last: SessionError },
    #[error("the replay server's run info: {0}")]
    Codec(#[from] CodecError),
    /// Another process has the same role and does not end, or the replay server refuses.
    #[error("{0}")]
    Refused(String),
}

/// Asks the replay server for the run's settings, waiting for it if it is not there yet, and for as long as it reads its replay back
/// from disk; `None` if told to stop before.
///
/// # Errors
/// No replay server answered within 60 s, or its protocol version differs.
pub fn run_info(
    session: &Session,
    keys: &Keys,
    shutdown: &Shutdown,
) -> Result<Option<RunInfo>, JoinError> {
    let mut patience = Patience::default();
    loop {
        match run_info_within(session, keys, TRY_MAX) {
            Ok(run_info) => return Ok(Some(run_info)),
            Err(e) => patience.wait_after(e)?,
        }
        if shutdown.wait_timeout(PAUSE) {
            return Ok(None);
        }
    }
}

/// Asks the replay server once for the run's settings.
pub fn run_info_within(
    session: &Session,
    keys: &Keys,
    wait_max: Duration,
) -> Result<RunInfo, SessionError> {
    let (key, nothing) = (keys.of::<RunInfo>(), ZBytes::new());
    session::send(session, &key, nothing, RunInfo::PRIORITY, wait_max)?
        .wait_for(|bytes| codec::decode(&bytes.to_bytes(), None).map(|(run_info, _)| run_info))
}

/// How long a joining process waits for its replay server, and what it logs meanwhile.
#[derive(Default)]
struct Patience {
    silence: Silence,
    silence_said: LogLimiter,
    recovery_said: LogLimiter,
}

impl Patience {
    /// Takes note that a try failed, and says now and then what is waited for; an error if another try is of no use.
    fn wait_after(&mut self, e: SessionError) -> Result<(), JoinError> {
        let e = match e {
            SessionError::Unreadable { why, .. } => return Err(why.into()),
            SessionError::Recovering(recovering) => {
                self.silence.answered();
                if recovering.progress.is_slow() && self.recovery_said.due().is_some() {
                    tracing::info!("waiting for as long as it takes: {recovering}");
                }
                return Ok(());
            }
            e => e,
        };
        let since = self.silence.unanswered();
        if since > SERVER_MAX {
            return Err(JoinError::NoReplayServer { last: e });
        }
        if since > SILENT_MAX && self.silence_said.due().is_some() {
            let (since, max) = (since.as_secs(), SERVER_MAX.as_secs());
            // A router may listen there, to which the replay server has yet to connect.
            let why = match e {
                SessionError::NoAnswerer { key } => format!(
                    "a process listens there, but does not answer at {key}: is it the replay server of this run, with the same --namespace?"
                ),
                other => other.to_string(),
            };
            tracing::info!(
                "waiting for the replay server since {since} s, for {max} s at most: {why}"
            );
        }
        Ok(())
    }
}

/// Takes part as an actor or as the run's learner; `None` if told to stop before.
///
/// # Errors
/// Another process has this role and stays; the replay server refuses, or does not answer for a minute.
pub fn take_part(
    client: &RunClient,
    join: &impl Request<Reply = JoinReply>,
    shutdown: &Shutdown,
) -> Result<Option<Welcome>, JoinError> {
    let mut patience = Patience::default();
    let mut taken: Option<Silence> = None;
    loop {
        match client.ask(join, TRY_MAX) {
            Ok(JoinReply::Welcome(welcome)) => return Ok(Some(welcome)),
            Ok(JoinReply::Refused { why }) => {
                let why = format!("the replay server refuses: {why}");
                return Err(JoinError::Refused(why));
            }
            Ok(JoinReply::Taken { why }) => match &mut taken {
                Some(silence) => {
                    if silence.unanswered() > TAKEN_MAX {
                        let seconds = TAKEN_MAX.as_secs();
                        let why = format!("{why}, and has not ended within {seconds} s");
                        return Err(JoinError::Refused(why));
                    }
                }
                None => {
                    let max = TAKEN_MAX.as_secs();
                    tracing::warn!("{why}; waiting up to {max} s for its end");
                    taken = Some(Silence::default());
                }
            },
            Err(e) => patience.wait_after(e)?,
        }
        if shutdown.wait_timeout(PAUSE) {
            return Ok(None);
        }
    }
}
