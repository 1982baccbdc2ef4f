//! Why no more batches come.

use std::time::Duration;

use driml_protocol::{CodecError, session::SessionError};

/// What keeps a learner from its batches.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs, reason = "each message says it")]
pub enum BatchError {
    #[error("no batch and no answer for {unreachable_max:?}")]
    Unreachable {
        unreachable_max: Duration,
        source: Box<Self>,
    },
    /// The replay server will not give what is asked for; it would refuse again.
    #[error("the replay server refuses: {0}")]
    Refused(String),
    /// A request that cannot be sent, or an answer that did not come.
    #[error(transparent)]
    Session(#[from] SessionError),
    #[error("a shard's status: {0}")]
    Status(SessionError),
    #[error(transparent)]
    Damaged(#[from] CodecError),
    #[error("the shards' parts do not fit together")]
    DifferentShards,
    /// The threads are gone although nothing has stopped them.
    #[error("the threads that fetch batches have ended")]
    ThreadsEnded,
}

impl BatchError {
    /// Whether a replay server has said that it reads its replay back from disk: it is there, and will answer.
    pub(crate) const fn is_recovering(&self) -> bool {
        matches!(
            self,
            Self::Session(SessionError::Recovering(_)) | Self::Status(SessionError::Recovering(_))
        )
    }
}
