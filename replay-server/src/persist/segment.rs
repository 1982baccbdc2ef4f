//! Segments: the files of a log, by number, and what each begins with.
//! Which are kept and how they are read back is for `journal` and `recover`.

use std::{
    fs, io,
    path::{Path, PathBuf},
};

use serde::{Deserialize, Serialize};

use super::snapshot::Snapshot;

/// Form of the log; one of another form is refused.
pub(super) const FORMAT: u32 = 3;
const PREFIX: &str = "segment-";
const SUFFIX: &str = ".log";

/// Highest number of a segment; files of higher ones are none of a log's.
const NUMBER_MAX: u64 = 1 << 60;

/// What a segment says first.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(super) struct SegmentHeader {
    pub(super) log: LogId,
    /// Number of the segment, from 0.
    pub(super) number: u64,
    /// The state before its first record.
    pub(super) snapshot: Snapshot,
}

/// A moment in the life of a replay that is kept on disk: the segment that begins there.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Mark(u64);

impl Mark {
    pub(super) const fn at(segment: u64) -> Self {
        Self(segment)
    }

    pub(super) const fn segment(self) -> u64 {
        self.0
    }
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct LogId {
    pub(super) format: u32,
    /// A random number, drawn when the log was begun.
    pub(super) identity: u64,
    /// Hash of the run spec.
    pub(super) spec_hash: u64,
    /// Which of the replay's shards it is, and how many there are.
    pub(super) shard: (u32, u32),
}

/// A segment of the log as it lies in the folder.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct SegmentFile {
    pub(super) number: u64,
    pub(super) path: PathBuf,
}

/// Path of segment `number` in `folder`.
pub(super) fn path(folder: &Path, number: u64) -> PathBuf {
    folder.join(format!("{PREFIX}{number:012}{SUFFIX}"))
}

/// All segments in `folder`, by number.
pub(super) fn list(folder: &Path) -> io::Result<Vec<SegmentFile>> {
    let mut segments = Vec::new();
    for entry in fs::read_dir(folder)? {
        let path = entry?.path();
        let name = path.file_name().and_then(|name| name.to_str());
        let digits = name.and_then(|name| name.strip_prefix(PREFIX)?.strip_suffix(SUFFIX));
        let number = digits.and_then(|digits| digits.parse().ok());
        if let Some(number) = number.filter(|&number| number <= NUMBER_MAX) {
            segments.push(SegmentFile { number, path });
        }
    }
    segments.sort_by_key(|it| it.number);
    Ok(segments)
}
