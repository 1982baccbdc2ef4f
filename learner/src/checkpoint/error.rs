//! Why a checkpoint is not written or read.

use std::{
    io,
    path::{Path, PathBuf},
};

use crate::error::UpdateError;

/// Why a checkpoint was not written or not read.
#[derive(Debug, thiserror::Error)]
pub enum CheckpointError {
    /// The file system refused.
    #[error("cannot {what} {path}: {why}")]
    Io {
        /// What was being done.
        what: &'static str,
        /// The file or folder to which it was being done.
        path: PathBuf,
        /// What the file system said.
        why: io::Error,
    },
    /// A file is not what was written.
    #[error(
        "{file} is damaged: {why}. To resume from the checkpoint before it, remove the folder it is in; \
         to begin anew, remove all checkpoint-* folders beside it"
    )]
    Damaged {
        /// The damaged file.
        file: PathBuf,
        /// What is wrong with it.
        why: String,
    },
    /// The checkpoint is another run's.
    #[error(
        "{folder} belongs to a run with specification {found}, this run's is {expected}: \
         resume with the settings it was made with, or choose another folder"
    )]
    OtherRun {
        /// The folder of the checkpoint.
        folder: PathBuf,
        /// Hash of the run that wrote it.
        found: String,
        /// Hash of this run.
        expected: String,
    },
    /// The checkpoint's network is another one.
    #[error(
        "the checkpoint {} was saved with {key} = {found}, this run has {key} = {expected}: \
         resume with the settings it was made with, or choose another folder", folder.display()
    )]
    OtherModel {
        /// The folder of the checkpoint.
        folder: PathBuf,
        /// The setting that differs.
        key: String,
        /// Its value in the checkpoint.
        found: String,
        /// Its value in this run.
        expected: String,
    },
    /// A learner cannot be restored from this state.
    #[error("nothing is saved, and the newest checkpoint stays the newest: {0}")]
    Unsound(UpdateError),
    /// The state does not fit the network or the settings.
    #[error("checkpoint: {0}")]
    Update(#[from] UpdateError),
    /// Another learner saves in the folder.
    #[error("another learner saves in {}: wait until it has ended, or choose another folder", .0.display())]
    InUse(PathBuf),
    /// The number of checkpoints to keep is 0.
    #[error("at least one checkpoint must be kept")]
    KeepNone,
}

/// The error of `what`, such as "read", done to `path`.
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
