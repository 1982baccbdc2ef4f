//! Why no more batches come.

use std::time::Duration;

use driml_protocol::{CodecError, session::SessionError};

/// What keeps a learner from its batches.
#[derive(Debug, thiserror::Error)]
pub enum BatchError {
    /// Every try failed for so long that the learner gives up.
    #[error("no batch and no answer for {unreachable_max:?}")]
    Unreachable {
        /// How long it has tried.
        unreachable_max: Duration,
        /// Why the last try failed.
        source: Box<Self>,
    },
    /// The replay server will not give what is asked for; it would refuse again.
    #[error("the replay server refuses: {0}")]
    Refused(String),
    /// A request that cannot be sent, or an answer that did not come.
    #[error(transparent)]
    Session(#[from] SessionError),
    /// A shard does not say how much it holds.
    #[error("a shard's status: {0}")]
    Status(SessionError),
    /// A batch that is damaged.
    #[error(transparent)]
    Damaged(#[from] CodecError),
    /// The shards gave batches of different kinds.
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
