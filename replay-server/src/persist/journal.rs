//! The writing side of the log of a replay that is in use: records at the end of the newest segment, new segments, marks, and the oldest
//! segments removed. When a record is due is for `upkeep`; it reads nothing back.

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
    folder::{LogFolder, LogId, Mark, PersistError, SegmentHeader, io_error},
    record::{self, RecordKind},
    snapshot::{Note, Snapshot},
    sync::Syncer,
};
use crate::storage::pack::PackedChunk;

/// A segment is at least this many times as long as the state that it begins with.
const SNAPSHOTS: u64 = 4;
/// How long the newest segment grows once another could not be begun, before that is tried again.
const RETRY: Duration = Duration::from_secs(1);
/// Marks that hold: if the newest is of a checkpoint that was not written whole, the one before it is wanted.
const MARKS: usize = 2;

/// One segment of the log that is in the folder.
#[derive(Debug)]
pub(super) struct Segment {
    pub(super) number: u64,
    pub(super) first_row: u64,
    pub(super) bytes: u64,
    /// Those of the state that it begins with; 0 where they do not matter any more.
    pub(super) snapshot_bytes: u64,
}

/// Where a log is continued.
#[derive(Default)]
pub(super) struct Place {
    /// The segments that are of use.
    pub(super) segments: VecDeque<Segment>,
    pub(super) number: u64,
    pub(super) ordinal: u64,
    /// The mark to which the log went back, and the oldest transition that was held then.
    pub(super) mark: Option<(Mark, u64)>,
}

/// How a log is written, and how much it may take.
#[derive(Clone, Copy, Debug)]
pub(super) struct LogLimits {
    /// From this size on, a segment is followed by another.
    pub(super) segment_bytes: u64,
    pub(super) disk_bytes_max: Option<u64>,
    /// How often it is flushed; zero after each write.
    pub(super) fsync: Duration,
}

struct Failing {
    since: Instant,
    /// What it said last.
    why: String,
}

/// The writing side of a log.
pub(crate) struct Journal {
    folder: LogFolder,
    id: LogId,
    /// All in the folder, the oldest first; the last one is written.
    segments: VecDeque<Segment>,
    pub(super) file: Arc<File>,
    ordinal: u64,
    limits: LogLimits,
    /// Bytes of the largest record so far, by which a segment may become larger than it should.
    largest: u64,
    syncer: Syncer,
    /// Records that the disk has refused so far; nothing is written before them.
    pending: Vec<u8>,
    failing: Option<Failing>,
    /// When another segment could not be begun, if none was since.
    not_begun: Option<Instant>,
    said: LogLimiter,
    /// The last two marks that were not given up, the newest last, each with the oldest transition that was held: what they need stays.
    marks: VecDeque<(Mark, u64)>,
}

impl Journal {
    /// Continues the log `id` from `place` on, in a new segment that begins with `snapshot`.
    pub(super) fn begin(
        folder: LogFolder,
        id: LogId,
        place: Place,
        limits: LogLimits,
        snapshot: &Snapshot,
    ) -> Result<Self, PersistError> {
        let syncer = File::open(&folder.path)
            .and_then(|opened| Syncer::start(opened, limits.fsync))
            .map_err(io_error("opening", &folder.path))?;
        let (number, mut segments) = (place.number, place.segments);
        let begun = begin_segment(&folder, id, number, place.ordinal, snapshot);
        let (segment, file) = begun.map_err(io_error("writing", &folder.segment(number)))?;
        segments.push_back(segment);
        syncer.opened(number, file.clone());
        Ok(Self {
            folder,
            id,
            segments,
            file,
            ordinal: place.ordinal + 1,
            limits,
            largest: 0,
            syncer,
            pending: Vec::new(),
            failing: None,
            not_begun: None,
            said: LogLimiter::default(),
            marks: place.mark.into_iter().collect(),
        })
    }

    pub(crate) const fn spec_hash(&self) -> u64 {
        self.id.spec_hash
    }

    pub(crate) fn flush(&mut self) {
        self.write_pending();
        self.syncer.flush();
    }

    pub(crate) fn status(&self) -> LogStatus {
        let refused = self.failing.as_ref();
        LogStatus {
            folder: self.folder.path.display().to_string(),
            bytes: self.bytes(),
            bytes_max: self.limits.disk_bytes_max,
            flushed_s: self.syncer.flushed_s(),
            refused: refused.map(|it| (it.since.elapsed().as_secs_f64(), it.why.clone())),
            unwritten_bytes: self.pending.len() as u64,
        }
    }

    pub(crate) fn bytes(&self) -> u64 {
        self.segments.iter().map(|it| it.bytes).sum()
    }

    /// Whether the disk has refused what was to be written last.
    pub(crate) const fn is_failing(&self) -> bool {
        self.failing.is_some()
    }

    /// Writes what the disk has refused before; whether all of it is written now.
    pub(crate) fn write_pending(&mut self) -> bool {
        let pending = std::mem::take(&mut self.pending);
        let is_written = pending.is_empty() || self.write(&pending, &[]);
        if !is_written {
            self.pending = pending;
        }
        is_written
    }

    /// Appends a note of what has happened; if the disk refuses, it is the first to be written later.
    pub(super) fn append_note(&mut self, note: &Note) {
        let body = codec::encode_value(note).expect("a note is far below the codec's limit");
        let record = record::head(RecordKind::Note, self.ordinal, &body, 0);
        self.ordinal += 1;
        self.pending.extend_from_slice(&record);
        self.write_pending();
    }

    /// Appends a chunk that is to be stored. `false`: the disk refuses, and it must not be. An error: it makes no message.
    pub(crate) fn append_chunk(&mut self, packed: &PackedChunk<'_>) -> Result<bool, String> {
        let head = packed.sealed.as_ref();
        let head = head.ok_or("the chunk is larger than a message may be")?;
        let payload = packed.chunk.payload();
        let record = record::head(RecordKind::Chunk, self.ordinal, head, payload.len());
        let is_written = self.write_pending() && self.write(&record, payload);
        self.ordinal += u64::from(is_written);
        Ok(is_written)
    }

    fn newest(&mut self) -> &mut Segment {
        self.segments
            .back_mut()
            .expect("a log always has the segment that it writes")
    }

    /// Writes at the end of the newest segment; if the disk refuses, the segment ends where it did.
    fn write(&mut self, record: &[u8], payload: &[u8]) -> bool {
        let &mut Segment {
            number, bytes: at, ..
        } = self.newest();
        let bytes = (record.len() + payload.len()) as u64;
        self.largest = self.largest.max(bytes);
        let written = self
            .file
            .write_all_at(record, at)
            .and_then(|()| self.file.write_all_at(payload, at + record.len() as u64))
            .and_then(|()| self.syncer.written(number, &self.file));
        if let Err(e) = written {
            // A partial record after the end is ignored on recovery; cutting it off makes room.
            if let Err(e) = self.file.set_len(at) {
                tracing::debug!("cutting off what was not written whole: {e}");
            }
            self.note_failing(&e);
            return false;
        }
        self.newest().bytes = at + bytes;
        if self.failing.take().is_some() {
            tracing::warn!(
                "the replay's log in {} can be written again; nothing was lost",
                self.folder.path.display()
            );
        }
        true
    }

    fn note_failing(&mut self, e: &io::Error) {
        let failing = self.failing.get_or_insert_with(|| Failing {
            since: Instant::now(),
            why: String::new(),
        });
        failing.why = e.to_string();
        if let Some(more) = self.said.due() {
            tracing::error!(
                "the replay's log in {} cannot be written: {e}; nothing more is stored until it can: make room or make it writable{more}",
                self.folder.path.display()
            );
        }
    }

    /// Whether another segment is due: the newest has its length, or may have lost what was written to it.
    pub(super) fn is_full(&self) -> bool {
        let is_full = |it: &Segment| {
            it.bytes >= self.length(it.snapshot_bytes) || self.syncer.has_lost(it.number)
        };
        self.pending.is_empty()
            && self.not_begun.is_none_or(|at| at.elapsed() >= RETRY)
            && self.segments.back().is_some_and(is_full)
    }

    /// From how many bytes on a segment that begins with such a state is followed by another.
    fn length(&self, snapshot_bytes: u64) -> u64 {
        let least = SNAPSHOTS * snapshot_bytes;
        self.limits.segment_bytes.max(least)
    }

    /// Where the disk budget does not allow another segment, with `snapshot`: the oldest transition that may stay.
    pub(super) fn over_budget(&self, snapshot: impl FnOnce() -> Snapshot) -> Option<u64> {
        let max = self.limits.disk_bytes_max?;
        let mut bytes = self.bytes() + self.length(snapshot().bytes()) + self.largest;
        let mut keep = None;
        for (segment, next) in self.segments.iter().zip(self.segments.iter().skip(1)) {
            if bytes <= max {
                break;
            }
            bytes -= segment.bytes;
            keep = Some(next.first_row);
        }
        keep
    }

    /// Begins another segment with `snapshot`. If the disk refuses, the newest one grows.
    pub(super) fn rotate(&mut self, snapshot: &Snapshot) {
        // What waits to be written has its place before the end of the old one.
        if !self.write_pending() {
            return;
        }
        let number = self.newest().number + 1;
        // The record that closes the old one comes first.
        let begun = begin_segment(&self.folder, self.id, number, self.ordinal + 1, snapshot);
        let (segment, file) = match begun {
            Ok(begun) => begun,
            Err(e) => return self.note_not_begun(&e),
        };
        let closed = record::head(RecordKind::Closed, self.ordinal, &[], 0);
        if !self.write(&closed, &[]) {
            // Without it the new one is one too many.
            remove(&self.folder.segment(number));
            return;
        }
        self.ordinal += 2;
        self.not_begun = None;
        self.file = file.clone();
        self.syncer.opened(number, file);
        self.segments.push_back(segment);
    }

    fn note_not_begun(&mut self, e: &io::Error) {
        self.not_begun = Some(Instant::now());
        if let Some(more) = self.said.due() {
            tracing::error!(
                "no new file can be begun in the replay's log in {}: {e}; the newest one grows until it can: make room or make the folder \
                 writable{more}",
                self.folder.path.display()
            );
        }
    }

    /// Begins another segment with `snapshot`, which is on the disk when this returns and stays.
    pub(super) fn mark(&mut self, snapshot: &Snapshot) -> Result<Mark, PersistError> {
        let before = self.newest().number;
        self.rotate(snapshot);
        let mark = Mark(self.newest().number);
        if mark.0 == before {
            let full = io::Error::other("it refuses to be written, as the log says");
            return Err(io_error("marking", &self.folder.path)(full));
        }
        let flushed = self.syncer.flushed();
        flushed.map_err(io_error("flushing", &self.folder.path))?;
        if self.marks.len() == MARKS {
            self.marks.pop_front();
        }
        self.marks.push_back((mark, snapshot.oldest));
        Ok(mark)
    }

    /// Nothing will go back to `mark`.
    pub(super) fn give_up(&mut self, mark: Mark) {
        self.marks.retain(|(it, _)| *it != mark);
    }

    /// Removes the oldest segments that neither the ring, whose oldest transition is `oldest_row`, nor a mark needs.
    pub(super) fn prune(&mut self, oldest_row: u64) {
        let (oldest, keep) = match self.marks.front() {
            Some((first, marked_row)) => (oldest_row.min(*marked_row), first.0),
            None => (oldest_row, u64::MAX),
        };
        while self.segments.len() > 1
            && self.segments[1].first_row <= oldest
            && self.segments[0].number < keep
        {
            let number = self.segments[0].number;
            self.syncer.removed(number);
            if !remove(&self.folder.segment(number)) {
                return;
            }
            self.segments.pop_front();
        }
    }
}

/// A new segment whose only record has the number `ordinal`; nothing stays if it cannot be written.
fn begin_segment(
    folder: &LogFolder,
    log: LogId,
    number: u64,
    ordinal: u64,
    snapshot: &Snapshot,
) -> io::Result<(Segment, Arc<File>)> {
    let header = SegmentHeader {
        log,
        number,
        snapshot: snapshot.clone(),
    };
    let body = codec::encode_value(&header).map_err(io::Error::other)?;
    let head = record::head(RecordKind::Segment, ordinal, &body, 0);
    let path = folder.segment(number);
    let file = File::create(&path)?;
    if let Err(e) = file.write_all_at(&head, 0) {
        remove(&path);
        return Err(e);
    }
    let segment = Segment {
        number,
        first_row: snapshot.inserted,
        bytes: head.len() as u64,
        snapshot_bytes: head.len() as u64,
    };
    Ok((segment, Arc::new(file)))
}

/// Removes a file; if that fails it is tried again, or does no harm.
pub(crate) fn remove(path: &Path) -> bool {
    match fs::remove_file(path) {
        Err(e) if e.kind() != io::ErrorKind::NotFound => {
            tracing::debug!("removing {}: {e}", path.display());
            false
        }
        _ => true,
    }
}
