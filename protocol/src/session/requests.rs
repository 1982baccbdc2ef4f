//! Sends requests over a session, answers them, and defines why either may fail.

use std::time::{Duration, Instant};

use zenoh::{
    Session, Wait,
    bytes::ZBytes,
    handlers::FifoChannelHandler,
    qos::{CongestionControl, Priority},
    query::{ConsolidationMode, Query, QueryTarget, Reply},
};

use crate::{
    messages::recovering::Recovering,
    reach::Unreachable,
    tls::TlsError,
    wire::{codec, error::CodecError},
};

/// Why a message could not be exchanged.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs, reason = "each message says it")]
pub enum SessionError {
    #[error(transparent)]
    Unreachable(#[from] Unreachable),
    #[error(transparent)]
    Tls(#[from] TlsError),
    #[error("{key}: no process answers there")]
    NoResponder { key: String },
    #[error("{key}: no answer within {within_ms} ms")]
    TimedOut { key: String, within_ms: u128 },
    /// The replay server runs, but still reads its replay back from disk. It answers afterwards, so a caller may wait without a limit.
    #[error("{0}")]
    Recovering(Recovering),
    #[error("{key}: {why}")]
    Unreadable { key: String, why: CodecError },
    /// The session could not be opened, a request is too large or could not be sent, or the other side replied with an error.
    #[error("{0}")]
    Failed(String),
}

/// zenoh's error reply if no process replies in time.
const TIMEOUT_TEXT: &str = "Timeout";

#[derive(Debug)]
pub(crate) struct PendingBytes {
    key: String,
    timeout: Duration,
    replies: FifoChannelHandler<Reply>,
    /// The error of the last reply, if no reply so far was accepted.
    failed: Option<SessionError>,
}

pub(crate) fn send(
    session: &Session,
    key: &str,
    payload: ZBytes,
    priority: Priority,
    timeout: Duration,
) -> Result<PendingBytes, SessionError> {
    let replies = session
        .get(key)
        .payload(payload)
        // Queries foreign processes too: with a single target, zenoh might choose one of them.
        .target(QueryTarget::All)
        .consolidation(ConsolidationMode::None)
        .congestion_control(CongestionControl::Block)
        .priority(priority)
        .timeout(timeout)
        .wait()
        .map_err(|e| SessionError::Failed(format!("{key}: {e}")))?;
    Ok(PendingBytes {
        key: key.into(),
        timeout,
        replies,
        failed: None,
    })
}

impl PendingBytes {
    /// Waits for the first reply that `read` accepts. Without certificates, foreign processes may reply too.
    pub(crate) fn wait_for<T>(
        &mut self,
        read: impl Fn(&ZBytes) -> Result<T, CodecError>,
    ) -> Result<T, SessionError> {
        loop {
            let reply = self.replies.recv().ok();
            if let Some(answer) = self.read(reply, &read)? {
                return Ok(answer);
            }
        }
    }

    /// Like [`PendingBytes::wait_for`] for at most `wait_max`; returns `None` if no such reply has arrived by then.
    pub(crate) fn wait_for_within<T>(
        &mut self,
        wait_max: Duration,
        read: impl Fn(&ZBytes) -> Result<T, CodecError>,
    ) -> Result<Option<T>, SessionError> {
        let deadline = Instant::now() + wait_max;
        loop {
            let reply = match self.replies.recv_deadline(deadline) {
                Ok(None) => return Ok(None),
                Ok(reply) => reply,
                Err(_) => None,
            };
            if let Some(answer) = self.read(reply, &read)? {
                return Ok(Some(answer));
            }
        }
    }

    /// Applies `read` to a reply; returns `None` if it fails and another may follow. `reply` is `None` after the last one.
    fn read<T>(
        &mut self,
        reply: Option<Reply>,
        read: impl Fn(&ZBytes) -> Result<T, CodecError>,
    ) -> Result<Option<T>, SessionError> {
        let key = || self.key.clone();
        let Some(reply) = reply else {
            let none = || SessionError::NoResponder { key: key() };
            return Err(self.failed.take().unwrap_or_else(none));
        };
        let failed = match reply.into_result() {
            Ok(sample) => match read(sample.payload()) {
                Ok(answer) => return Ok(Some(answer)),
                Err(why) => SessionError::Unreadable { key: key(), why },
            },
            Err(e) => {
                if let Ok((recovering, _)) = codec::decode(&e.payload().to_bytes(), None) {
                    return Err(SessionError::Recovering(recovering));
                }
                let why = e.payload().try_to_string().unwrap_or_default().into_owned();
                match why.as_str() {
                    TIMEOUT_TEXT => SessionError::TimedOut {
                        key: key(),
                        within_ms: self.timeout.as_millis(),
                    },
                    _ => SessionError::Failed(format!("{}: {why}", self.key)),
                }
            }
        };
        self.failed = Some(failed);
        Ok(None)
    }
}

/// Sends one request and returns the bytes of its first reply, unchecked.
pub fn ask(
    session: &Session,
    key: &str,
    payload: ZBytes,
    priority: Priority,
    timeout: Duration,
) -> Result<ZBytes, SessionError> {
    send(session, key, payload, priority, timeout)?.wait_for(|bytes| Ok(bytes.clone()))
}

/// Answers `query` with `payload`. If the requester has gone away, this is logged and ignored.
pub fn answer(query: &Query, payload: ZBytes) {
    if let Err(e) = query.reply(query.key_expr().clone(), payload).wait() {
        tracing::debug!("{}: the requesting process is gone: {e}", query.key_expr());
    }
}

/// Answers `query` with the error `payload`, because it cannot be handled now. The requester retries.
pub(crate) fn reply_error(query: &Query, payload: ZBytes) {
    if let Err(e) = query.reply_err(payload).wait() {
        tracing::debug!("{}: the requesting process is gone: {e}", query.key_expr());
    }
}
