//! Why a session could not be opened, or a question not be answered.

use crate::{
    messages::recovering::Recovering, reach::Unreachable, tls::TlsError, wire::error::CodecError,
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
    NoAnswerer { key: String },
    #[error("{key}: no answer within {within_ms} ms")]
    NoReply { key: String, within_ms: u128 },
    /// The replay server is reading its replay back from disk, and will answer then. It is there: this may be waited for as long as it
    /// takes.
    #[error("{0}")]
    Recovering(Recovering),
    #[error("{key}: {why}")]
    Unreadable { key: String, why: CodecError },
    /// The session could not be opened, a request is too large or could not be sent, or the other side replied with an error.
    #[error("{0}")]
    Failed(String),
}
