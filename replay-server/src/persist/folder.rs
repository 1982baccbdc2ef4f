//! The folder of a log: locked for one server, with a file that identifies the replay, and the log's segments.
//! `journal` writes the segments; `recover` reads them.

use std::{
    ffi::OsStr,
    fs::{self, File},
    io,
    path::{Path, PathBuf},
};

use driml_protocol::{PROTOCOL_VERSION, atomic_write, lock_file};
use serde::{Deserialize, Serialize};

use super::snapshot::Snapshot;

/// Format of the log (thousands) and of the messages in it (ones). A log of another format is rejected.
pub(super) const LOG_FORMAT: u32 = 6_000 + PROTOCOL_VERSION as u32;
/// The file that identifies the log.
const ID_FILE: &str = "log.toml";
/// Maximum number of a segment. Files with higher numbers do not belong to a log.
const SEGMENT_NUMBER_MAX: u64 = 1 << 60;

/// Why a replay cannot be read from or written to its folder.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs, reason = "each message says it")]
pub enum PersistError {
    #[error("{doing} {}: {source}; --replay-dir needs a folder with room that this process may write", path.display())]
    Io {
        doing: &'static str,
        path: PathBuf,
        source: io::Error,
    },
    #[error("another replay server keeps its replay in {}: end it first, or choose another --replay-dir", .0.display())]
    InUse(PathBuf),
    /// The content of this file or folder belongs to another run or version, or is invalid although its checksum is right. The text says
    /// why, and what to do.
    #[error("{path} {1}", path = .0.display())]
    Unusable(PathBuf, String),
    /// The log cannot be rolled back to a mark: this file, its segment, is missing or damaged.
    #[error("{} is missing or damaged: the replay cannot be rolled back to the checkpoint", .0.display())]
    NoMark(PathBuf),
    #[error("it was stopped while it read its replay back; its files are unchanged")]
    Stopped,
    #[error(transparent)]
    Config(#[from] driml_protocol::config::ConfigError),
}

pub(super) fn io_error(
    doing: &'static str,
    path: &Path,
) -> impl FnOnce(io::Error) -> PersistError + use<> {
    let path = path.to_owned();
    move |source| PersistError::Io {
        doing,
        path,
        source,
    }
}

/// A moment of a replay on disk to which its log can be rolled back: the number of the segment that begins there.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Mark(pub(super) u64);

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct LogId {
    pub(super) format: u32,
    /// A random number, drawn when the log was begun.
    pub(super) identity: u64,
    pub(super) spec_hash: u64,
    pub(super) shard: (u32, u32),
}

/// The body of a segment's first record.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(super) struct SegmentHeader {
    pub(super) log: LogId,
    pub(super) number: u64,
    /// The replay's state where the segment begins.
    pub(super) snapshot: Snapshot,
}

/// A folder that this process has locked.
pub(super) struct LogFolder {
    pub(super) path: PathBuf,
    _lock: File,
}

impl LogFolder {
    /// Creates the folder if it does not exist, and locks it against other servers.
    pub(super) fn open(path: &Path) -> Result<Self, PersistError> {
        fs::create_dir_all(path).map_err(io_error("making", path))?;
        let lock = path.join(".lock");
        let lock = lock_file::acquire(&lock, "start no other replay server there")
            .map_err(io_error("locking", &lock))?
            .ok_or_else(|| PersistError::InUse(path.to_owned()))?;
        Ok(Self {
            path: path.to_owned(),
            _lock: lock,
        })
    }

    pub(super) fn segment_path(&self, number: u64) -> PathBuf {
        self.path.join(format!("segment-{number:012}.log"))
    }

    pub(super) fn segment_numbers(&self) -> Result<Vec<u64>, PersistError> {
        let number = |entry: io::Result<fs::DirEntry>| {
            let name = entry?.file_name();
            let name = name.to_str();
            let digits = name.and_then(|it| it.strip_prefix("segment-")?.strip_suffix(".log"));
            let number = digits.and_then(|digits| digits.parse().ok());
            // Ignores a copy named without the leading zeros, as its number is another segment's.
            let is_own = |&number: &u64| {
                let own = self.segment_path(number);
                number <= SEGMENT_NUMBER_MAX && own.file_name().and_then(OsStr::to_str) == name
            };
            Ok(number.filter(is_own))
        };
        let numbers = fs::read_dir(&self.path)
            .and_then(|entries| entries.map(number).collect::<io::Result<Vec<_>>>())
            .map_err(io_error("listing", &self.path))?;
        let mut numbers: Vec<_> = numbers.into_iter().flatten().collect();
        numbers.sort_unstable();
        Ok(numbers)
    }

    pub(super) fn read_segment(&self, number: u64) -> Result<Vec<u8>, PersistError> {
        let path = self.segment_path(number);
        fs::read(&path).map_err(io_error("reading", &path))
    }

    pub(super) fn truncate_segment(&self, number: u64, at: usize) -> Result<(), PersistError> {
        let path = self.segment_path(number);
        let opened = File::options().write(true).open(&path);
        opened
            .and_then(|opened| opened.set_len(at as u64))
            .map_err(io_error("cutting off the end of", &path))
    }

    pub(super) fn remove_segment(&self, number: u64) -> Result<(), PersistError> {
        let path = self.segment_path(number);
        fs::remove_file(&path).map_err(io_error("removing", &path))
    }

    pub(super) fn read_id(&self) -> Result<Option<LogId>, PersistError> {
        let path = self.path.join(ID_FILE);
        let text = match fs::read_to_string(&path) {
            Err(e) if e.kind() == io::ErrorKind::NotFound => return Ok(None),
            read => read.map_err(io_error("reading", &path))?,
        };
        toml::from_str(&text).map(Some).map_err(|e| {
            let why = format!("cannot be read: {}", e.message());
            PersistError::Unusable(path, why)
        })
    }

    pub(super) fn write_id(&self, id: &LogId) -> Result<(), PersistError> {
        let path = self.path.join(ID_FILE);
        let text = toml::to_string(id).expect("a struct of numbers is TOML");
        let text =
            format!("# The replay that a replay server of driml keeps in this folder.\n{text}");
        atomic_write::write(&path, text.as_bytes()).map_err(io_error("writing", &path))
    }

    /// Checks that `found` is the log of the run and shard of `ours`.
    pub(super) fn check_same_run(&self, found: &LogId, ours: &LogId) -> Result<(), PersistError> {
        let unusable = |why| Err(PersistError::Unusable(self.path.clone(), why));
        if found.format != LOG_FORMAT {
            return unusable(format!(
                "holds a replay of format {}, this version reads {LOG_FORMAT}: choose another --replay-dir",
                found.format
            ));
        }
        let ((shard, shards), (our_shard, our_shards)) = (found.shard, ours.shard);
        let why = if found.shard != ours.shard {
            format!("shard {shard} of {shards}; this is shard {our_shard} of {our_shards}")
        } else if found.spec_hash != ours.spec_hash {
            let (theirs, ours) = (found.spec_hash, ours.spec_hash);
            format!("its run spec has the hash {theirs:016x}, this run's {ours:016x}")
        } else {
            return Ok(());
        };
        unusable(format!(
            "holds the replay of another run ({why}): use that run's settings, or choose another --replay-dir"
        ))
    }
}
