//! Why no more batches come.

use std::time::Duration;

use driml_protocol::{CodecError, session::SessionError};

/// Why a learner gets no batches.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs, reason = "each message says it")]
pub enum BatchError {
    #[error("no batch and no answer for {unreachable_max:?}")]
    Unreachable {
        unreachable_max: Duration,
        source: Box<Self>,
    },
    /// The replay server rejects the request, and would reject a retry.
    #[error("the replay server rejects the learner: {0}")]
    Refused(String),
    /// A request could not be sent, or its reply did not arrive.
    #[error(transparent)]
    Session(#[from] SessionError),
    #[error("a shard's status: {0}")]
    Status(SessionError),
    #[error(transparent)]
    Damaged(#[from] CodecError),
    #[error("the shards' parts do not fit together")]
    DifferentShards,
    /// The threads have ended without a shutdown.
    #[error("the threads that fetch batches have ended")]
    ThreadsEnded,
}

impl BatchError {
    /// Whether a replay server has replied that it recovers its replay from disk. It is reachable, and will serve batches later.
    pub(crate) const fn is_recovering(&self) -> bool {
        matches!(
            self,
            Self::Session(SessionError::Recovering(_)) | Self::Status(SessionError::Recovering(_))
        )
    }
}
