//! Why a checkpoint is not written or read.

use std::{
    io,
    path::{Path, PathBuf},
};

use crate::error::UpdateError;

/// Why a checkpoint was not written or not read.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs, reason = "each message says it")]
pub enum CheckpointError {
    #[error("cannot {what} {path}: {why}")]
    Io {
        what: &'static str,
        path: PathBuf,
        why: io::Error,
    },
    #[error(
        "{} is damaged: {why}. To resume from the checkpoint before it, remove {}; \
         to begin anew, remove all checkpoint-* folders beside it",
        file.display(), file.parent().unwrap_or(file).display()
    )]
    Damaged { file: PathBuf, why: String },
    /// Another version of this program wrote the checkpoint, or its run had another specification, network or estimator of the affinity.
    #[error("{0}")]
    Mismatch(String),
    /// No learner could be restored from the state, for example because a weight is not finite.
    #[error("the checkpoint was not saved, and the newest one is still that before it: {0}")]
    Unsound(UpdateError),
    /// The state does not fit the network or the settings.
    #[error("checkpoint: {0}")]
    Update(#[from] UpdateError),
    #[error("another learner saves in {}: wait until it has exited, or choose another folder", .0.display())]
    InUse(PathBuf),
}

/// Makes the error of an operation `what`, such as "read", on `path`.
pub(super) fn io_error<'a>(
    what: &'static str,
    path: &'a Path,
) -> impl FnOnce(io::Error) -> CheckpointError + 'a {
    move |why| CheckpointError::Io {
        what,
        path: path.to_owned(),
        why,
    }
}

pub(super) fn damaged(folder: &Path, file: &str, why: String) -> CheckpointError {
    CheckpointError::Damaged {
        file: folder.join(file),
        why,
    }
}
