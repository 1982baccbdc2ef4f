//! The folder of a log: locked for one server, with a file that identifies the replay, and the log's segments.
//! `journal` writes the segments; `recover` reads them.

use std::{
    ffi::OsStr,
    fs::{self, File},
    io,
    path::{Path, PathBuf},
    time::Duration,
};

use driml_protocol::{PROTOCOL_VERSION, RunSpec, TRANSITION_BYTES, atomic_write, codec, lock_file};
use serde::{Deserialize, Serialize};

use super::{record, snapshot::Snapshot};
use crate::config::{Config, SEGMENT_BYTES_MIN};

/// Format of the log (thousands) and of the messages in it (ones). A log of another format is rejected.
const LOG_FORMAT: u32 = 7_000 + PROTOCOL_VERSION as u32;
/// The file that identifies the log.
const ID_FILE: &str = "log.toml";
/// Maximum number of a segment. Files with higher numbers do not belong to a log.
const SEGMENT_NUMBER_MAX: u64 = 1 << 60;
/// Default period between flushes of the log.
const FSYNC_DEFAULT: Duration = Duration::from_secs(1);
/// Maximum segment size unless it is given: small enough that the log keeps little beyond the content of the ring.
const SEGMENT_BYTES_MAX: u64 = 1 << 26;
/// Number of segments that the ring or the disk budget should span at least.
const SEGMENTS_MIN: u64 = 16;

/// Why a replay cannot be read from or written to its folder.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs, reason = "each message says it")]
pub enum PersistError {
    #[error("{doing} {}: {source}; the replay needs a folder with room that this process may write", path.display())]
    Io {
        doing: &'static str,
        path: PathBuf,
        source: io::Error,
    },
    #[error("another replay server keeps its replay in {}: end it first, or choose another --replay-dir", .0.display())]
    InUse(PathBuf),
    /// This file or folder belongs to another run or version, or is invalid although its checksum is right; why, and what to do.
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

/// Where a replay is kept on disk, and which shard of the run it is.
#[derive(Clone, Debug, Default)]
pub struct PersistArgs {
    /// The folder, for this replay alone.
    pub dir: PathBuf,
    /// The number of the shard, from 0.
    pub shard: u32,
    /// Size from which a segment is followed by another. Default: a size that suits the ring.
    pub segment_bytes: Option<u64>,
    /// The mark to which the log is rolled back: all records after it are removed.
    pub mark: Option<Mark>,
}

#[derive(Clone, Copy, Debug)]
pub(super) struct LogLimits {
    /// Size from which a segment is followed by another.
    pub(super) segment_bytes: u64,
    pub(super) disk_bytes_max: Option<u64>,
    /// Period between flushes of the log; zero flushes after each write.
    pub(super) fsync_period: Duration,
}

/// The folder of a replay of this run, locked for this process.
pub struct ReplayFolder {
    pub(crate) path: PathBuf,
    pub(super) id: LogId,
    pub(super) limits: LogLimits,
    /// The mark at which the log is to end, if any: then all state is restored.
    pub(super) mark: Option<Mark>,
    _lock: File,
}

impl ReplayFolder {
    /// Creates the folder if it does not exist, locks it against other servers, and checks that a log in it belongs to this run. Does not
    /// read the log, which may take long.
    pub fn open(args: &PersistArgs, spec: &RunSpec, config: &Config) -> Result<Self, PersistError> {
        config.check_on_disk()?;
        let path = &args.dir;
        fs::create_dir_all(path).map_err(io_error("making", path))?;
        let lock = path.join(".lock");
        let lock = lock_file::acquire(&lock, "start no other replay server there")
            .map_err(io_error("locking", &lock))?
            .ok_or_else(|| PersistError::InUse(path.clone()))?;
        let mut folder = Self {
            path: path.clone(),
            id: LogId {
                format: LOG_FORMAT,
                identity: rand::random(),
                spec_hash: spec.hash(),
                shard: (args.shard, config.shards),
            },
            limits: log_limits(args, spec, config),
            mark: args.mark,
            _lock: lock,
        };
        let known = match folder.read_id()? {
            Some(id) => Some(id),
            None => newest_header(path)?.map(|it| it.log),
        };
        if let Some(known) = known {
            folder.check_same_run(&known)?;
            folder.id = known;
        }
        Ok(folder)
    }

    pub(super) fn segment_path(&self, number: u64) -> PathBuf {
        segment_path(&self.path, number)
    }

    /// Reads a segment and flushes it, as the process that wrote it may have died before it did.
    pub(super) fn read_segment(&self, number: u64) -> Result<Vec<u8>, PersistError> {
        let path = self.segment_path(number);
        let read = File::open(&path).and_then(|it| it.sync_data().and(fs::read(&path)));
        read.map_err(io_error("reading", &path))
    }

    pub(super) fn truncate_segment(&self, number: u64, at: usize) -> Result<(), PersistError> {
        let path = self.segment_path(number);
        let opened = File::options().write(true).open(&path);
        opened
            .and_then(|opened| opened.set_len(at as u64).and(opened.sync_all()))
            .map_err(io_error("cutting off the end of", &path))
    }

    pub(super) fn remove_segment(&self, number: u64) -> Result<(), PersistError> {
        let path = self.segment_path(number);
        fs::remove_file(&path).map_err(io_error("removing", &path))
    }

    fn read_id(&self) -> Result<Option<LogId>, PersistError> {
        let path = self.path.join(ID_FILE);
        let text = match fs::read_to_string(&path) {
            Err(e) if e.kind() == io::ErrorKind::NotFound => return Ok(None),
            read => read.map_err(io_error("reading", &path))?,
        };
        toml::from_str(&text).map(Some).map_err(|e| {
            let why = format!(
                "cannot be read: {}; remove it, the segments have the same",
                e.message()
            );
            PersistError::Unusable(path, why)
        })
    }

    pub(super) fn write_id(&self) -> Result<(), PersistError> {
        let path = self.path.join(ID_FILE);
        let text = toml::to_string(&self.id).expect("a struct of numbers is TOML");
        let text =
            format!("# The replay that a replay server of driml keeps in this folder.\n{text}");
        atomic_write::write(&path, text.as_bytes()).map_err(io_error("writing", &path))
    }

    /// Checks that `found` is the log of this run and shard.
    fn check_same_run(&self, found: &LogId) -> Result<(), PersistError> {
        let ours = &self.id;
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

/// The size of a whole replay whose log is kept.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct KeptSize {
    /// Its setting `replay.capacity_transitions`.
    pub capacity_transitions: u64,
    /// Its setting `replay.compressed_bytes_max`.
    pub compressed_bytes_max: Option<u64>,
}

/// Returns the size of the whole replay whose log for shard `shard` of `shards` is in `dir`, as of the newest segment; `None` if there is no
/// log that can be read.
pub fn kept_size(dir: &Path, shard: u32, shards: u32) -> Option<KeptSize> {
    let newest = newest_header(&shard_dir(dir, shard, shards)).ok()??;
    Some(KeptSize {
        capacity_transitions: newest.snapshot.capacity.saturating_mul(shards.into()),
        compressed_bytes_max: newest.snapshot.compressed_bytes_max,
    })
}

pub(crate) fn shard_dir(dir: &Path, shard: u32, shards: u32) -> PathBuf {
    match shards {
        1 => dir.to_owned(),
        _ => dir.join(format!("shard-{shard}")),
    }
}

fn segment_path(folder: &Path, number: u64) -> PathBuf {
    folder.join(format!("segment-{number:012}.log"))
}

pub(super) fn segment_numbers(folder: &Path) -> Result<Vec<u64>, PersistError> {
    let number = |entry: io::Result<fs::DirEntry>| {
        let name = entry?.file_name();
        let name = name.to_str();
        let digits = name.and_then(|it| it.strip_prefix("segment-")?.strip_suffix(".log"));
        let number = digits.and_then(|digits| digits.parse().ok());
        // Ignores a copy named without the leading zeros, as its number is another segment's.
        let is_own = |&number: &u64| {
            let own = segment_path(folder, number);
            number <= SEGMENT_NUMBER_MAX && own.file_name().and_then(OsStr::to_str) == name
        };
        Ok(number.filter(is_own))
    };
    let numbers = fs::read_dir(folder)
        .and_then(|entries| entries.map(number).collect::<io::Result<Vec<_>>>())
        .map_err(io_error("listing", folder))?;
    let mut numbers: Vec<_> = numbers.into_iter().flatten().collect();
    numbers.sort_unstable();
    Ok(numbers)
}

/// Returns the header of the newest segment whose header can be read; `None` if there is none.
fn newest_header(folder: &Path) -> Result<Option<SegmentHeader>, PersistError> {
    for number in segment_numbers(folder)?.into_iter().rev() {
        let path = segment_path(folder, number);
        let bytes = fs::read(&path).map_err(io_error("reading", &path))?;
        if let Ok(record) = record::read_first(&bytes)
            && let Ok(header) = codec::decode_value(record.body)
        {
            return Ok(Some(header));
        }
    }
    Ok(None)
}

/// Returns the size of a segment, the disk budget of the shard, and the period between flushes.
fn log_limits(args: &PersistArgs, spec: &RunSpec, config: &Config) -> LogLimits {
    let shards = u64::from(config.shards);
    let disk_bytes_max = config.disk_bytes_max.map(|max| max / shards);
    let transition_bytes = spec.frame_bytes() as u64 + TRANSITION_BYTES as u64;
    let ring = (config.capacity_transitions / shards).saturating_mul(transition_bytes);
    let all = disk_bytes_max.map_or(ring, |max| max.min(ring));
    let fitting = (all / SEGMENTS_MIN).clamp(SEGMENT_BYTES_MIN, SEGMENT_BYTES_MAX);
    LogLimits {
        segment_bytes: args.segment_bytes.unwrap_or(fitting),
        disk_bytes_max,
        fsync_period: config.fsync_ms.map_or(FSYNC_DEFAULT, Duration::from_millis),
    }
}
