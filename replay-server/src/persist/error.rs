//! Why a replay cannot be kept on disk, in words that say what to do.

use std::{io, path::PathBuf};

use crate::config::ConfigError;

/// What keeps a replay from its folder.
#[derive(Debug, thiserror::Error)]
pub enum PersistError {
    /// A file or folder that cannot be read or written.
    #[error("{doing} {}: {source}; --replay-dir needs a folder with room that this process may write", path.display())]
    Io {
        /// What was being done.
        doing: &'static str,
        /// With which file or folder.
        path: PathBuf,
        /// What the system answered.
        source: io::Error,
    },
    /// Another replay server uses the folder.
    #[error("another replay server keeps its replay in {}: end it first, or choose another --replay-dir", .0.display())]
    InUse(PathBuf),
    /// What is in this file or folder is not this run's, is of another version, or makes no sense although its checksum is right: why,
    /// and what to do.
    #[error("{path} {1}", path = .0.display())]
    Unusable(PathBuf, String),
    /// The log does not reach back to a mark, which is this file.
    #[error("{} is missing or damaged: the replay cannot go back to where the checkpoint was made", .0.display())]
    NoMark(PathBuf),
    /// The process was told to end before the log was read.
    #[error("it was told to end while it read its replay back; what is kept was not changed")]
    Stopped,
    /// Settings that cannot work.
    #[error(transparent)]
    Config(#[from] ConfigError),
}
