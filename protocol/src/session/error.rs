//! Why a session could not be opened, or a question not be answered.

use crate::{
    messages::recovering::Recovering, reach::Unreachable, tls::TlsError, wire::error::CodecError,
};

/// Why a message could not be exchanged.
#[derive(Debug, thiserror::Error)]
pub enum SessionError {
    /// Nothing accepts connections where the session was to connect.
    #[error(transparent)]
    Unreachable(#[from] Unreachable),
    /// A certificate is not good.
    #[error(transparent)]
    Tls(#[from] TlsError),
    /// No process answers at this key.
    #[error("{key}: no process answers there")]
    NoAnswerer {
        /// Where it was asked.
        key: String,
    },
    /// No answer in time.
    #[error("{key}: no answer within {within_ms} ms")]
    NoReply {
        /// Where it was asked.
        key: String,
        /// How long the reply was waited for.
        within_ms: u128,
    },
    /// The replay server is reading its replay back from disk, and will answer then. It is there: this may be waited for as long as it
    /// takes.
    #[error("{0}")]
    Recovering(Recovering),
    /// A reply that is damaged, foreign or of another kind.
    #[error("{key}: {why}")]
    Unreadable {
        /// Where it was asked.
        key: String,
        /// What is wrong with it.
        why: CodecError,
    },
    /// The session could not be opened, a request is too large or could not be sent, or the other side replied with an error.
    #[error("{0}")]
    Failed(String),
}
