//! Why a replay cannot be kept on disk, in words that say what to do.

use std::{io, path::PathBuf};

use driml_protocol::CodecError;

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
        /// What the system said.
        source: io::Error,
    },
    /// Another replay server uses the folder.
    #[error("another replay server keeps its replay in {}: end it first, or choose another --replay-dir", .0.display())]
    InUse(PathBuf),
    /// The folder is that of another run.
    #[error(
        "{} holds the replay of another run ({why}): go on with that run's settings, or choose another --replay-dir",
        folder.display()
    )]
    Foreign {
        /// The folder.
        folder: PathBuf,
        /// How it differs.
        why: String,
    },
    /// The folder was written by another version.
    #[error("{} holds a replay of format {theirs}, this version reads {ours}: choose another --replay-dir", folder.display())]
    Format {
        /// The folder.
        folder: PathBuf,
        /// Its format.
        theirs: u32,
        /// Ours.
        ours: u32,
    },
    /// A state that does not fit this run although its checksum does.
    #[error("{}: {why}", path.display())]
    State {
        /// The segment.
        path: PathBuf,
        /// What is wrong.
        why: String,
    },
    /// The log does not reach back to a mark.
    #[error("{} is missing or damaged: the replay cannot go back to where the checkpoint was made", .0.display())]
    NoMark(PathBuf),
    /// The process was told to end before the log was read.
    #[error("it was told to end while it read its replay back; what is kept is as it was")]
    Stopped,
    /// A value that cannot be written.
    #[error(transparent)]
    Codec(#[from] CodecError),
    /// Settings that cannot work.
    #[error(transparent)]
    Config(#[from] ConfigError),
}
