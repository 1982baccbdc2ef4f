//! Writes the log of a running replay: appends records to the newest segment, begins segments, sets marks and removes the oldest segments.
//! `upkeep` decides when a record is written. Nothing is read back here.

use std::{
    collections::VecDeque,
    fs::{self, File},
    io,
    os::unix::fs::FileExt,
    path::Path,
    sync::Arc,
    time::{Duration, Instant},
};

use driml_protocol::{LogLimiter, LogStatus, codec};

use super::{
    folder::{Mark, PersistError, ReplayFolder, SegmentHeader, io_error},
    record::{self, RecordKind},
    snapshot::{ProcessEvent, Snapshot},
    sync::Syncer,
};
use crate::storage::pack::PackedChunk;

/// The minimum length of a segment, in multiples of the snapshot that it begins with.
const SNAPSHOTS_PER_SEGMENT_MIN: u64 = 4;
/// Time until a retry after a new segment could not be begun. Meanwhile the newest segment grows.
const RETRY: Duration = Duration::from_secs(1);
/// Number of marks kept. If the newest belongs to a checkpoint that was not written completely, the one before it is needed.
const MARKS_KEPT: usize = 2;

/// A segment of the log that is in the folder.
#[derive(Debug)]
pub(super) struct Segment {
    pub(super) number: u64,
    pub(super) first_transition: u64,
    pub(super) bytes: u64,
    /// Bytes of the snapshot that the segment begins with; 0 for a segment that was read back, to which nothing more is written.
    pub(super) snapshot_bytes: u64,
}

/// The position at which a log is continued.
#[derive(Default)]
pub(super) struct LogPosition {
    /// The usable segments.
    pub(super) segments: VecDeque<Segment>,
    pub(super) next_segment: u64,
    pub(super) next_ordinal: u64,
    /// The mark to which the log was rolled back, and the oldest transition that was held then.
    pub(super) mark: Option<(Mark, u64)>,
}

struct WriteFailure {
    since: Instant,
    why: String,
}

/// The writing side of a log.
pub(crate) struct Journal {
    folder: ReplayFolder,
    /// All segments in the folder, oldest first. Records are written to the last one.
    segments: VecDeque<Segment>,
    pub(super) file: Arc<File>,
    ordinal: u64,
    /// Bytes of the largest record so far. A segment may exceed its length by this much.
    largest: u64,
    syncer: Syncer,
    /// Records that the disk has rejected so far. No other record is written before them.
    pending: Vec<u8>,
    write_failure: Option<WriteFailure>,
    /// When a new segment could not be begun; `None` if one was begun since.
    rotate_failed_at: Option<Instant>,
    log_limiter: LogLimiter,
    /// The last two marks not discarded, newest last, each with the oldest transition held then. Segments that they need are kept.
    marks: VecDeque<(Mark, u64)>,
}

impl Journal {
    /// Continues the log in `folder` from `position` on, in a new segment that begins with `snapshot`.
    pub(super) fn begin(
        folder: ReplayFolder,
        position: LogPosition,
        snapshot: &Snapshot,
    ) -> Result<Self, PersistError> {
        let syncer = File::open(&folder.path)
            .and_then(|opened| Syncer::start(opened, folder.limits.fsync_period))
            .map_err(io_error("opening", &folder.path))?;
        let (number, mut segments) = (position.next_segment, position.segments);
        let begun = create_segment(&folder, number, position.next_ordinal, snapshot);
        let (segment, file) = begun.map_err(io_error("writing", &folder.segment_path(number)))?;
        segments.push_back(segment);
        syncer.add_segment(number, file.clone());
        Ok(Self {
            folder,
            segments,
            file,
            ordinal: position.next_ordinal + 1,
            largest: 0,
            syncer,
            pending: Vec::new(),
            write_failure: None,
            rotate_failed_at: None,
            log_limiter: LogLimiter::default(),
            marks: position.mark.into_iter().collect(),
        })
    }

    pub(crate) const fn spec_hash(&self) -> u64 {
        self.folder.id.spec_hash
    }

    pub(crate) fn flush(&mut self) {
        self.write_pending();
        self.syncer.flush_or_warn();
    }

    pub(crate) fn status(&self) -> LogStatus {
        let refused = self.write_failure.as_ref();
        LogStatus {
            folder: self.folder.path.display().to_string(),
            bytes: self.bytes(),
            bytes_max: self.folder.limits.disk_bytes_max,
            flushed_s: self.syncer.since_flush_s(),
            refused: refused.map(|it| (it.since.elapsed().as_secs_f64(), it.why.clone())),
            unwritten_bytes: self.pending.len() as u64,
        }
    }

    pub(crate) fn bytes(&self) -> u64 {
        self.segments.iter().map(|it| it.bytes).sum()
    }

    /// Whether the last write to the disk failed.
    pub(crate) const fn is_failing(&self) -> bool {
        self.write_failure.is_some()
    }

    /// Writes the records that the disk has rejected before. Returns whether all are written now.
    pub(crate) fn write_pending(&mut self) -> bool {
        let pending = std::mem::take(&mut self.pending);
        let is_written = pending.is_empty() || self.write(&pending, &[]);
        if !is_written {
            self.pending = pending;
        }
        is_written
    }

    /// Appends an event. If the disk rejects it, the event stays pending and is written before any other record.
    pub(super) fn append_event(&mut self, event: &ProcessEvent) {
        let body = codec::encode_value(event).expect("a note is far below the codec's limit");
        let record = record::encode_head(RecordKind::Event, self.ordinal, &body, 0);
        self.ordinal += 1;
        self.pending.extend_from_slice(&record);
        self.write_pending();
    }

    /// Appends a chunk before it is stored. `false`: the disk rejects it, so do not store it. Error: it is too large for a message.
    pub(crate) fn append_chunk(&mut self, packed: &PackedChunk<'_>) -> Result<bool, String> {
        let head = packed.message_head.as_ref();
        let head = head.ok_or("the chunk is larger than a message may be")?;
        let payload = packed.chunk.payload();
        let record = record::encode_head(RecordKind::Chunk, self.ordinal, head, payload.len());
        let is_written = self.write_pending() && self.write(&record, payload);
        self.ordinal += u64::from(is_written);
        Ok(is_written)
    }

    fn newest_segment(&mut self) -> &mut Segment {
        self.segments
            .back_mut()
            .expect("a log always has the segment that it writes")
    }

    /// Writes at the end of the newest segment. If the write fails, the segment's end does not move.
    fn write(&mut self, record: &[u8], payload: &[u8]) -> bool {
        let &mut Segment {
            number, bytes: at, ..
        } = self.newest_segment();
        let bytes = (record.len() + payload.len()) as u64;
        self.largest = self.largest.max(bytes);
        let written = self
            .file
            .write_all_at(record, at)
            .and_then(|()| self.file.write_all_at(payload, at + record.len() as u64))
            .and_then(|()| self.syncer.after_write(number, &self.file));
        if let Err(e) = written {
            // A partial record after the end is ignored on recovery; cutting it off makes room.
            if let Err(e) = self.file.set_len(at) {
                tracing::debug!("cutting off what was not written whole: {e}");
            }
            self.record_write_failure(&e);
            return false;
        }
        self.newest_segment().bytes = at + bytes;
        if self.write_failure.take().is_some() {
            tracing::warn!(
                "the replay's log in {} can be written again; it has all stored transitions",
                self.folder.path.display()
            );
        }
        true
    }

    fn record_write_failure(&mut self, e: &io::Error) {
        let write_failure = self.write_failure.get_or_insert_with(|| WriteFailure {
            since: Instant::now(),
            why: String::new(),
        });
        write_failure.why = e.to_string();
        if let Some(more) = self.log_limiter.admit() {
            tracing::error!(
                "the replay's log in {} cannot be written: {e}; nothing more is stored until it can: make room or make it writable{more}",
                self.folder.path.display()
            );
        }
    }

    /// Whether a new segment is due: the newest has reached its length, or a failed flush may have lost data written to it.
    pub(super) fn needs_rotation(&self) -> bool {
        let needs_rotation = |it: &Segment| {
            it.bytes >= self.rotation_bytes(it.snapshot_bytes) || self.syncer.has_failed(it.number)
        };
        self.pending.is_empty()
            && self.rotate_failed_at.is_none_or(|at| at.elapsed() >= RETRY)
            && self.segments.back().is_some_and(needs_rotation)
    }

    /// Returns the size from which a segment with such a snapshot is followed by another.
    fn rotation_bytes(&self, snapshot_bytes: u64) -> u64 {
        let least = SNAPSHOTS_PER_SEGMENT_MIN * snapshot_bytes;
        self.folder.limits.segment_bytes.max(least)
    }

    /// If the disk budget has no room for a new segment with `snapshot`, returns the oldest transition that may stay.
    pub(super) fn oldest_within_budget(&self, snapshot: impl FnOnce() -> Snapshot) -> Option<u64> {
        let max = self.folder.limits.disk_bytes_max?;
        let mut bytes = self.bytes() + self.rotation_bytes(snapshot().bytes()) + self.largest;
        let mut keep = None;
        for (segment, next) in self.segments.iter().zip(self.segments.iter().skip(1)) {
            if bytes <= max {
                break;
            }
            bytes -= segment.bytes;
            keep = Some(next.first_transition);
        }
        keep
    }

    /// Begins a new segment with `snapshot`. If the disk rejects it, the newest segment keeps growing.
    pub(super) fn rotate(&mut self, snapshot: &Snapshot) {
        // Pending records belong before the end of the old segment.
        if !self.write_pending() {
            return;
        }
        let number = self.newest_segment().number + 1;
        // The record that closes the old segment gets the ordinal before this one.
        let begun = create_segment(&self.folder, number, self.ordinal + 1, snapshot);
        let (segment, file) = match begun {
            Ok(begun) => begun,
            Err(e) => return self.record_rotation_failure(&e),
        };
        let closed = record::encode_head(RecordKind::Closed, self.ordinal, &[], 0);
        if !self.write(&closed, &[]) {
            // Without that record, the new segment must not stay.
            try_remove(&self.folder.segment_path(number));
            return;
        }
        self.ordinal += 2;
        self.rotate_failed_at = None;
        self.file = file.clone();
        self.syncer.add_segment(number, file);
        self.segments.push_back(segment);
    }

    fn record_rotation_failure(&mut self, e: &io::Error) {
        self.rotate_failed_at = Some(Instant::now());
        if let Some(more) = self.log_limiter.admit() {
            tracing::error!(
                "no new file can be created in the replay's log in {}: {e}; the newest one grows until it can: make room or make the folder \
                 writable{more}",
                self.folder.path.display()
            );
        }
    }

    /// Begins a new segment with `snapshot`. It is flushed when this returns, and kept as long as the mark.
    pub(super) fn mark(&mut self, snapshot: &Snapshot) -> Result<Mark, PersistError> {
        let before = self.newest_segment().number;
        self.rotate(snapshot);
        let mark = Mark(self.newest_segment().number);
        if mark.0 == before {
            let full = io::Error::other("its log cannot be written; the process's log says why");
            return Err(io_error("marking", &self.folder.path)(full));
        }
        let flushed = self.syncer.try_flush();
        flushed.map_err(io_error("flushing", &self.folder.path))?;
        if self.marks.len() == MARKS_KEPT {
            self.marks.pop_front();
        }
        self.marks.push_back((mark, snapshot.oldest));
        Ok(mark)
    }

    /// Discards `mark`: the log will not be rolled back to it.
    pub(super) fn discard_mark(&mut self, mark: Mark) {
        self.marks.retain(|(it, _)| *it != mark);
    }

    /// Removes the oldest segments that neither the ring, whose oldest transition is `oldest_transition`, nor a mark needs.
    pub(super) fn prune(&mut self, oldest_transition: u64) {
        let (oldest, keep) = match self.marks.front() {
            Some((first, marked_oldest)) => (oldest_transition.min(*marked_oldest), first.0),
            None => (oldest_transition, u64::MAX),
        };
        while self.segments.len() > 1
            && self.segments[1].first_transition <= oldest
            && self.segments[0].number < keep
        {
            let number = self.segments[0].number;
            self.syncer.forget_segment(number);
            if !try_remove(&self.folder.segment_path(number)) {
                return;
            }
            self.segments.pop_front();
        }
    }
}

/// Creates a segment whose only record has the ordinal `ordinal`. Leaves no file if the write fails.
fn create_segment(
    folder: &ReplayFolder,
    number: u64,
    ordinal: u64,
    snapshot: &Snapshot,
) -> io::Result<(Segment, Arc<File>)> {
    let header = SegmentHeader {
        log: folder.id,
        number,
        snapshot: snapshot.clone(),
    };
    let body = codec::encode_value(&header).map_err(io::Error::other)?;
    let head = record::encode_head(RecordKind::Segment, ordinal, &body, 0);
    let path = folder.segment_path(number);
    let file = File::create(&path)?;
    if let Err(e) = file.write_all_at(&head, 0) {
        try_remove(&path);
        return Err(e);
    }
    let segment = Segment {
        number,
        first_transition: snapshot.inserted,
        bytes: head.len() as u64,
        snapshot_bytes: head.len() as u64,
    };
    Ok((segment, Arc::new(file)))
}

/// Removes a file. Returns false on failure, which is harmless: either the caller retries, or the file does no damage.
pub(crate) fn try_remove(path: &Path) -> bool {
    match fs::remove_file(path) {
        Err(e) if e.kind() != io::ErrorKind::NotFound => {
            tracing::debug!("removing {}: {e}", path.display());
            false
        }
        _ => true,
    }
}
