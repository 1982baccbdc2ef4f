//! Sends requests over a session, answers them, and defines why either may fail.

use std::{
    marker::PhantomData,
    time::{Duration, Instant},
};

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
    wire::{
        buffers::{Buffer, BufferPool},
        codec,
        error::CodecError,
        message::Message,
    },
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
    #[error(transparent)]
    Recovering(Recovering),
    #[error("{key}: {why}")]
    Unreadable { key: String, why: CodecError },
    /// The session could not be opened, a request is too large or could not be sent, or the other side replied with an error.
    #[error("{0}")]
    Failed(String),
}

/// zenoh's error reply if no process replies in time.
const TIMEOUT_TEXT: &str = "Timeout";

/// A reply of type `M` that has yet to arrive.
#[derive(Debug)]
pub struct PendingReply<M> {
    key: String,
    timeout: Duration,
    replies: FifoChannelHandler<Reply>,
    /// The hash of the run that the reply must belong to, if this process knows it.
    spec_hash: Option<u64>,
    /// The error of the last reply, if no reply so far was accepted.
    failed: Option<SessionError>,
    message: PhantomData<fn() -> M>,
}

pub(crate) fn send<M>(
    session: &Session,
    key: String,
    payload: ZBytes,
    priority: Priority,
    timeout: Duration,
    spec_hash: Option<u64>,
) -> Result<PendingReply<M>, SessionError> {
    let replies = session
        .get(&key)
        .payload(payload)
        // Queries foreign processes too: with a single target, zenoh might choose one of them.
        .target(QueryTarget::All)
        .consolidation(ConsolidationMode::None)
        .congestion_control(CongestionControl::Block)
        .priority(priority)
        .timeout(timeout)
        .wait()
        .map_err(|e| SessionError::Failed(format!("{key}: {e}")))?;
    Ok(PendingReply {
        key,
        timeout,
        replies,
        spec_hash,
        failed: None,
        message: PhantomData,
    })
}

impl<M: Message> PendingReply<M> {
    /// Waits for a reply without a payload.
    pub fn wait(mut self) -> Result<M, SessionError> {
        self.wait_for(decode)
    }

    /// Waits for the reply for at most `wait_max`; returns `None` if it has not arrived by then.
    pub fn wait_within(&mut self, wait_max: Duration) -> Result<Option<M>, SessionError> {
        let deadline = Instant::now() + wait_max;
        loop {
            let reply = match self.replies.recv_deadline(deadline) {
                Ok(None) => return Ok(None),
                Ok(reply) => reply,
                Err(_) => None,
            };
            if let Some(answer) = self.read(reply, decode)? {
                return Ok(Some(answer));
            }
        }
    }

    /// Waits for the reply and copies its payload into private memory from `pool`.
    pub fn receive(mut self, pool: &BufferPool) -> Result<(M, Buffer), SessionError> {
        self.wait_for(|bytes, hash| codec::decode_from(bytes.reader(), bytes.len(), pool, hash))
    }
}

fn decode<M: Message>(bytes: &ZBytes, spec_hash: Option<u64>) -> Result<M, CodecError> {
    codec::decode(&bytes.to_bytes(), spec_hash).map(|(message, _)| message)
}

impl<M> PendingReply<M> {
    /// Waits for the first reply whose bytes `read` accepts. Without certificates, foreign processes may reply too.
    fn wait_for<T>(
        &mut self,
        read: impl Fn(&ZBytes, Option<u64>) -> Result<T, CodecError>,
    ) -> Result<T, SessionError> {
        loop {
            let reply = self.replies.recv().ok();
            if let Some(answer) = self.read(reply, &read)? {
                return Ok(answer);
            }
        }
    }

    /// Applies `read` to a reply; returns `None` if it fails and another may follow. `reply` is `None` after the last one.
    fn read<T>(
        &mut self,
        reply: Option<Reply>,
        read: impl Fn(&ZBytes, Option<u64>) -> Result<T, CodecError>,
    ) -> Result<Option<T>, SessionError> {
        let key = || self.key.clone();
        let Some(reply) = reply else {
            let none = || SessionError::NoResponder { key: key() };
            return Err(self.failed.take().unwrap_or_else(none));
        };
        let failed = match reply.into_result() {
            Ok(sample) => match read(sample.payload(), self.spec_hash) {
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
    send::<()>(session, key.into(), payload, priority, timeout, None)?
        .wait_for(|bytes, _| Ok(bytes.clone()))
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
