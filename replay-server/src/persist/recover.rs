//! Reads a log back: restores the replay as it was when the last complete record was written, and finds what is damaged or missing.
//! Transitions are restored by the code that stored them. Lost transitions leave a gap that no row of a batch reaches into.

use std::{
    borrow::Cow,
    fs,
    path::{Path, PathBuf},
    sync::atomic::{AtomicU64, Ordering},
    time::{Duration, Instant},
};

use driml_protocol::{BufferPool, Chunk, RecoveryProgress, Shutdown, codec};

use super::{
    folder::{Mark, PersistError, ReplayFolder, SegmentHeader, segment_numbers},
    journal::{LogPosition, Segment},
    record::{self, ORDINAL_MAX, Record, RecordError, RecordKind},
    snapshot::ProcessEvent,
};
use crate::{replay::Replay, storage::pack::Packer};

const UNUSABLE_EXTENSION: &str = "unusable";
/// Period between log lines about the progress.
const LOG_PERIOD: Duration = Duration::from_secs(5);

/// The progress of reading a log, for clients that ask meanwhile, and a flag that stops the reading early.
#[derive(Debug)]
pub struct RecoveryControl {
    started: Instant,
    bytes: AtomicU64,
    bytes_read: AtomicU64,
    stop: Shutdown,
}

impl RecoveryControl {
    /// Starts at nothing read. Raising `stop` stops the reading early.
    pub fn new(stop: Shutdown) -> Self {
        Self {
            started: Instant::now(),
            bytes: AtomicU64::new(0),
            bytes_read: AtomicU64::new(0),
            stop,
        }
    }

    /// Returns the current progress.
    pub fn progress(&self) -> RecoveryProgress {
        RecoveryProgress {
            bytes_read: self.bytes_read.load(Ordering::Relaxed),
            bytes: self.bytes.load(Ordering::Relaxed),
            since_s: self.started.elapsed().as_secs_f64(),
        }
    }
}

/// The result of reading a log.
#[derive(Clone, Debug, Default)]
pub struct RecoveryReport {
    /// Whether the folder held a replay.
    pub found: bool,
    /// Bytes of the log that were read.
    pub bytes: u64,
    /// Damage and its consequences, as sentences for a person.
    pub warnings: Vec<String>,
}

pub(super) fn roll_back(folder: &ReplayFolder, mark: Mark) -> Result<(), PersistError> {
    let no_mark = || PersistError::NoMark(folder.segment_path(mark.0));
    let numbers = segment_numbers(&folder.path)?;
    if !numbers.contains(&mark.0) {
        return Err(no_mark());
    }
    let bytes = folder.read_segment(mark.0)?;
    let first = record::read_first(&bytes).ok();
    let first = first.filter(|it| it.kind == RecordKind::Segment);
    let first = first.ok_or_else(no_mark)?;
    // The newest first: if this is interrupted, the remaining log is valid and ends earlier.
    for later in numbers.into_iter().rev().filter(|it| *it > mark.0) {
        folder.remove_segment(later)?;
    }
    folder.truncate_segment(mark.0, first.bytes())
}

/// Restores `replay`, which must be empty, from the segments of the log in `folder`. With a mark, which must be the end of the log, all of
/// the replay's state is taken from the mark's snapshot.
pub(super) fn recover(
    folder: &ReplayFolder,
    replay: &mut Replay,
    control: &RecoveryControl,
) -> Result<(LogPosition, RecoveryReport), PersistError> {
    let mut numbers = segment_numbers(&folder.path)?;
    // After a power cut, segments may be empty that were begun after the last one with records.
    while let [_, .., last] = numbers[..]
        && folder.read_segment(last)?.iter().all(|byte| *byte == 0)
    {
        folder.remove_segment(last)?;
        numbers.pop();
    }
    let packer = replay.packer();
    replay.is_recovering = true;
    let mut reader = LogReader {
        folder,
        replay,
        packer,
        pool: BufferPool::new(2),
        position: LogPosition {
            next_segment: numbers.last().map_or(0, |it| it + 1),
            ..LogPosition::default()
        },
        recovery: RecoveryReport::default(),
        oldest: 0,
        has_same_capacity: false,
        unusable: Vec::new(),
        closed: None,
    };
    let bytes = |&number| fs::metadata(folder.segment_path(number)).map_or(0, |it| it.len());
    let total: u64 = numbers.iter().map(bytes).sum();
    let dir = folder.path.display();
    if let count @ 1.. = numbers.len() {
        tracing::info!(
            "reads the replay in {dir}: {count} segments, {} MiB; requests are answered with its progress",
            total >> 20
        );
    }
    control.bytes.store(total, Ordering::Relaxed);
    let mut next_log = Instant::now() + LOG_PERIOD;
    for (at, &number) in numbers.iter().enumerate() {
        if Instant::now() > next_log {
            next_log = Instant::now() + LOG_PERIOD;
            tracing::info!("reads the replay in {dir}: {}", control.progress());
        }
        if control.stop.is_set() {
            return Err(PersistError::Stopped);
        }
        let segment = folder.read_segment(number)?;
        reader.read_segment(number, &segment, at + 1 == numbers.len())?;
        let bytes = segment.len() as u64;
        control.bytes_read.fetch_add(bytes, Ordering::Relaxed);
    }
    reader.finish()
}

/// Reads a log into a replay.
struct LogReader<'a> {
    folder: &'a ReplayFolder,
    replay: &'a mut Replay,
    packer: Packer,
    pool: BufferPool,
    position: LogPosition,
    recovery: RecoveryReport,
    /// The oldest transition that was held, by the last snapshot.
    oldest: u64,
    /// Whether the ring has the capacity that it had before and no limit in bytes, in memory or on disk, so that the number stored tells
    /// which are held.
    has_same_capacity: bool,
    /// Segments that cannot be used. They are renamed once it is known that others can.
    unusable: Vec<PathBuf>,
    /// The name of the last segment that was read, if a record closes it: another segment was begun after it.
    closed: Option<String>,
}

impl LogReader<'_> {
    fn warn(&mut self, text: String) {
        self.recovery.warnings.push(text);
    }

    fn read_segment(
        &mut self,
        number: u64,
        bytes: &[u8],
        is_last: bool,
    ) -> Result<(), PersistError> {
        let path = self.folder.segment_path(number);
        let name = file_name(&path);
        let first = match record::read_first(bytes) {
            // The server died while it began this segment, which is empty.
            Err(RecordError::Torn) if is_last => return self.folder.remove_segment(number),
            first => first.ok().filter(|it| it.kind == RecordKind::Segment),
        };
        let header = first.and_then(|first| {
            let header = codec::decode_value::<SegmentHeader>(first.body);
            header.ok().map(|it| (it, first.ordinal, first.bytes()))
        });
        let Some((header, ordinal, at)) = header else {
            self.mark_unusable(path, "its beginning is damaged");
            return Ok(());
        };
        if header.log != self.folder.id {
            self.warn(format!("{name} is not of this log and was left unchanged"));
            return Ok(());
        }
        let is_first = !self.recovery.found;
        let follows = is_first || ordinal >= self.position.next_ordinal;
        if header.number != number || !follows {
            self.mark_unusable(path, "it is not the segment that belongs here");
            return Ok(());
        }
        let unusable =
            |why: String| PersistError::Unusable(path.clone(), format!("cannot be used: {why}"));
        let snapshot = header.snapshot;
        let is_prioritised = self.replay.config.sampling.is_prioritised();
        if self.folder.mark == Some(Mark(number)) {
            if snapshot.rows.is_prioritised() != is_prioritised {
                let why = "replay.sampling differs from the rule that was used before".into();
                return Err(unusable(why));
            }
            self.position.mark = Some((Mark(number), snapshot.oldest));
        }
        let (stored, first_transition) = (self.replay.ring.inserted(), snapshot.inserted);
        self.oldest = snapshot.oldest;
        self.has_same_capacity = snapshot.capacity == self.replay.ring.capacity()
            && self.replay.config.compressed_bytes_max.is_none()
            && self.replay.config.disk_bytes_max.is_none();
        self.replay.restore(snapshot).map_err(unusable)?;
        if !is_first && first_transition > stored {
            self.warn(format!(
                "the transitions {stored} to {} are lost: something before {name} is damaged or missing. All others are there, and all \
                 counts are right",
                first_transition - 1
            ));
        }
        self.recovery.found = true;
        self.position.next_ordinal = ordinal + 1;
        let (at, ended) = self.read_records(bytes, at);
        let cut = bytes.len() - at;
        self.recovery.bytes += at as u64;
        self.position.segments.push_back(Segment {
            number,
            first_transition,
            bytes: if is_last { at } else { bytes.len() } as u64,
            snapshot_bytes: 0,
        });
        self.closed = matches!(ended, Ok(true)).then(|| name.clone());
        match ended {
            Ok(_) => {}
            Err(RecordError::Misfit(why)) => {
                return Err(unusable(format!("{why}. Start with the earlier settings")));
            }
            Err(_) if !is_last => self.warn(format!(
                "{name} is damaged at byte {at}: {cut} bytes of it cannot be used"
            )),
            // No actor was told that this record is stored.
            Err(RecordError::Torn) => tracing::info!(
                "the last record of {name} was not written whole: its {cut} bytes are cut off"
            ),
            Err(RecordError::Damaged) => self.warn(format!(
                "{name} is damaged at byte {at}: the {cut} bytes from there on are cut off, as nothing after them can be trusted. What was stored \
                 and served then is lost"
            )),
        }
        match cut {
            1.. if is_last => self.folder.truncate_segment(number, at),
            _ => Ok(()),
        }
    }

    fn mark_unusable(&mut self, path: PathBuf, why: &str) {
        self.warn(format!("{} cannot be used, {why}", file_name(&path)));
        self.unusable.push(path);
    }

    /// Applies the records of a segment from byte `at` on. Returns the end of the last usable record, and whether that record closes the
    /// segment, or why the rest is unusable.
    fn read_records(&mut self, bytes: &[u8], mut at: usize) -> (usize, Result<bool, RecordError>) {
        let mut is_closed = false;
        while at < bytes.len() {
            let record = match record::read_first(&bytes[at..]) {
                Ok(record) => record,
                Err(error) => return (at, Err(error)),
            };
            if is_closed || record.ordinal != self.position.next_ordinal {
                return (at, Err(RecordError::Damaged));
            }
            if let Err(error) = self.apply(&record) {
                return (at, Err(error));
            }
            self.position.next_ordinal += 1;
            is_closed = record.kind == RecordKind::Closed;
            at += record.bytes();
        }
        (at, Ok(is_closed))
    }

    fn apply(&mut self, record: &Record<'_>) -> Result<(), RecordError> {
        let damaged = |why: String| {
            tracing::debug!("record {}: {why}", record.ordinal);
            RecordError::Damaged
        };
        match record.kind {
            RecordKind::Closed => Ok(()),
            RecordKind::Segment => Err(damaged("a segment begins within another".into())),
            RecordKind::Chunk => {
                let (hash, len) = (self.folder.id.spec_hash, record.body.len());
                let chunk = codec::decode_from(record.body, len, &self.pool, Some(hash))
                    .and_then(|(header, payload)| Chunk::from_payload(header, payload))
                    .map_err(|e| damaged(e.to_string()))?;
                // It fitted when it was written: another capacity does not make it damaged.
                self.replay
                    .check_chunk(&chunk)
                    .map_err(RecordError::Misfit)?;
                let actors = &self.replay.state.actors;
                actors.check_sender(&chunk.header).map_err(damaged)?;
                let packed = self.packer.pack(Cow::Owned(chunk));
                self.replay.store(&packed);
                Ok(())
            }
            RecordKind::Event => {
                let event = codec::decode_value(record.body);
                match event.map_err(|e| damaged(e.to_string()))? {
                    ProcessEvent::ActorJoined(join) => self.replay.join_actor(join).map(drop),
                    ProcessEvent::Forgotten(actors) => {
                        self.replay.state.actors.forget(&actors);
                        Ok(())
                    }
                    ProcessEvent::Leave(leave) => self.replay.leave(&leave).map_or(Ok(()), Err),
                    ProcessEvent::LearnerJoined(join) => self.replay.join_learner(join).map(drop),
                }
                .map_err(damaged)
            }
        }
    }

    fn finish(mut self) -> Result<(LogPosition, RecoveryReport), PersistError> {
        let unusable = |why: String| {
            let why = format!("cannot be used: {why}; to begin a new replay, remove its segments");
            Err(PersistError::Unusable(self.folder.path.clone(), why))
        };
        if !self.recovery.found && !self.recovery.warnings.is_empty() {
            let why = self.recovery.warnings.join("; ");
            return unusable(format!("no segment can be read ({why})"));
        }
        if let Some(name) = self.closed.take() {
            self.warn(format!(
                "no segment after {name} can be read: the replay is what it was when the next one began; what was stored and served since is lost"
            ));
        }
        // The records written next must be readable too.
        if self.position.next_ordinal > ORDINAL_MAX / 2 {
            let last = self.position.next_ordinal - 1;
            return unusable(format!(
                "its records are numbered up to {last}, which no replay reaches"
            ));
        }
        for path in std::mem::take(&mut self.unusable) {
            let (name, renamed) = (file_name(&path), path.with_extension(UNUSABLE_EXTENSION));
            self.warn(match fs::rename(&path, &renamed) {
                Ok(()) => format!("{name} is now {}", file_name(&renamed)),
                Err(e) => format!("{name} stays there, as it cannot be renamed: {e}"),
            });
        }
        // Older segments are removed once none of their transitions is held.
        let ring = &self.replay.ring;
        let (first, end) = (ring.first_index(), ring.inserted());
        let held_from = self.oldest.max(end.saturating_sub(ring.capacity()));
        if self.has_same_capacity && held_from < first {
            self.warn(format!(
                "the transitions {held_from} to {} are lost: the oldest segments are missing. All others are there, and all counts are right",
                first - 1
            ));
        }
        let replay = self.replay;
        replay.is_recovering = false;
        if self.recovery.found && self.folder.mark.is_none() {
            // Draws since the last snapshot are unknown: the learner reports their number, and another random stream is used from here on.
            replay.awaits_row_count = replay.state.learner.is_some();
            replay.state.set_rng_stream(replay.origin.shard, end);
        }
        Ok((self.position, self.recovery))
    }
}

fn file_name(path: &Path) -> String {
    let name = path.file_name();
    name.map_or_else(String::new, |name| name.to_string_lossy().into_owned())
}
