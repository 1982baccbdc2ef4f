//! The writing side of the log: records at the end of the newest segment, new segments, and the oldest removed.
//! When a record is due is for `upkeep`; it reads nothing back.

use std::{
    collections::VecDeque,
    fs::{self, File},
    io,
    os::unix::fs::FileExt,
    path::{Path, PathBuf},
    sync::Arc,
    time::{Duration, Instant},
};

use driml_protocol::{LogStatus, Seldom, codec};

use super::{
    error::PersistError,
    folder::io_error,
    record::{self, RecordKind},
    segment::{self, LogId, Mark, SegmentFile, SegmentHeader},
    snapshot::{Note, Snapshot},
    sync::Syncer,
};

/// One segment of the log that is in the folder.
struct Segment {
    number: u64,
    /// The first transition that it may hold.
    first_row: u64,
    bytes: u64,
}

/// The writing side of a log.
pub(crate) struct Journal {
    folder: PathBuf,
    id: LogId,
    /// All in the folder, the oldest first; the last one is written.
    segments: VecDeque<Segment>,
    file: Arc<File>,
    /// Number of the next record.
    ordinal: u64,
    limits: Limits,
    /// Bytes of the largest record so far, by which a segment may become larger than it should.
    largest: u64,
    syncer: Syncer,
    /// Records that the disk has refused so far; nothing is written before them.
    pending: Vec<u8>,
    failing: Option<Failing>,
}

/// Where a log is continued.
#[derive(Default)]
pub(super) struct Place {
    /// The segments that are of use, each with its first transition.
    pub(super) segments: Vec<(SegmentFile, u64)>,
    /// Number of the next segment.
    pub(super) number: u64,
    /// Number of the next record.
    pub(super) ordinal: u64,
}

/// How much a log may take.
#[derive(Clone, Copy, Debug)]
pub(super) struct Limits {
    /// From this size on, a segment is followed by another.
    pub(super) segment_bytes: u64,
    /// Most that all segments take.
    pub(super) disk_bytes_max: Option<u64>,
}

struct Failing {
    since: Instant,
    /// What it said last.
    why: String,
    said: Seldom,
}

impl Journal {
    /// Continues the log `id` from `place` on, in a new segment that begins with `snapshot`.
    pub(super) fn begin(
        folder: &Path,
        id: LogId,
        place: &Place,
        limits: Limits,
        fsync: Duration,
        snapshot: &Snapshot,
    ) -> Result<Self, PersistError> {
        let mut segments = VecDeque::new();
        for (file, first_row) in &place.segments {
            let metadata = fs::metadata(&file.path).map_err(io_error("looking at", &file.path))?;
            segments.push_back(Segment {
                number: file.number,
                first_row: *first_row,
                bytes: metadata.len(),
            });
        }
        let syncer = File::open(folder)
            .and_then(|opened| Syncer::start(opened, fsync))
            .map_err(io_error("opening", folder))?;
        let path = segment::path(folder, place.number);
        let begun = begin_segment(folder, id, place.number, place.ordinal, snapshot);
        let (segment, file) = begun.map_err(io_error("writing", &path))?;
        segments.push_back(segment);
        syncer.opened(place.number, file.clone());
        Ok(Self {
            folder: folder.to_owned(),
            id,
            segments,
            file,
            ordinal: place.ordinal + 1,
            limits,
            largest: 0,
            syncer,
            pending: Vec::new(),
            failing: None,
        })
    }

    pub(crate) fn flush(&mut self) {
        self.is_ready();
        self.syncer.flush();
    }

    pub(crate) fn status(&self) -> LogStatus {
        let refused = self.failing.as_ref();
        LogStatus {
            folder: self.folder.display().to_string(),
            bytes: self.bytes(),
            bytes_max: self.limits.disk_bytes_max,
            flushed_s: self.syncer.flushed_s(),
            refused: refused.map(|it| (it.since.elapsed().as_secs_f64(), it.why.clone())),
            unwritten_bytes: self.pending.len() as u64,
        }
    }

    /// Bytes on disk.
    pub(crate) fn bytes(&self) -> u64 {
        self.segments.iter().map(|it| it.bytes).sum()
    }

    /// Writes what the disk has refused before; whether all of it is written now.
    pub(crate) fn is_ready(&mut self) -> bool {
        if self.pending.is_empty() {
            return true;
        }
        let pending = std::mem::take(&mut self.pending);
        match self.write(&pending, &[]) {
            Ok(()) => {
                self.note_well();
                true
            }
            Err(e) => {
                self.pending = pending;
                self.note_failing(&e);
                false
            }
        }
    }

    /// Appends a note of what has happened; if the disk refuses, it is the first to be written later.
    pub(super) fn append_note(&mut self, note: &Note) {
        let body = codec::encode_value(note).expect("a note is far below the codec's limit");
        let record = record::head(RecordKind::Note, self.ordinal, &body, 0);
        self.ordinal += 1;
        if !self.is_ready() {
            self.pending.extend_from_slice(&record);
        } else if let Err(e) = self.write(&record, &[]) {
            self.pending = record;
            self.note_failing(&e);
        }
    }

    /// Appends a chunk that is to be stored: head and payload of its message. `false`: the disk refuses, and it must not be.
    pub(super) fn append_chunk(&mut self, head: &[u8], payload: &[u8]) -> bool {
        if !self.is_ready() {
            return false;
        }
        let record = record::head(RecordKind::Chunk, self.ordinal, head, payload.len());
        match self.write(&record, payload) {
            Ok(()) => {
                self.ordinal += 1;
                self.note_well();
                true
            }
            Err(e) => {
                self.note_failing(&e);
                false
            }
        }
    }

    /// Whether the disk has refused what was to be written last.
    pub(crate) const fn is_failing(&self) -> bool {
        self.failing.is_some()
    }

    fn newest(&mut self) -> &mut Segment {
        self.segments
            .back_mut()
            .expect("a log always has the segment that it writes")
    }

    /// Writes at the end of the newest segment; on an error the segment ends where it did.
    fn write(&mut self, record: &[u8], payload: &[u8]) -> io::Result<()> {
        let at = self.newest().bytes;
        let bytes = (record.len() + payload.len()) as u64;
        self.largest = self.largest.max(bytes);
        let written = self
            .file
            .write_all_at(record, at)
            .and_then(|()| self.file.write_all_at(payload, at + record.len() as u64))
            .and_then(|()| self.syncer.written());
        if written.is_err() {
            // What stays behind the end is not whole, and is taken for nothing; this makes room.
            if let Err(e) = self.file.set_len(at) {
                tracing::debug!("cutting off what was not written whole: {e}");
            }
            return written;
        }
        self.newest().bytes = at + bytes;
        Ok(())
    }

    fn note_failing(&mut self, e: &io::Error) {
        let failing = self.failing.get_or_insert_with(|| Failing {
            since: Instant::now(),
            why: String::new(),
            said: Seldom::default(),
        });
        failing.why = e.to_string();
        if let Some(more) = failing.said.due() {
            tracing::error!(
                "the replay's log in {} cannot be written: {e}; nothing more is stored until it can: make room or make it writable{more}",
                self.folder.display()
            );
        }
    }

    fn note_well(&mut self) {
        if self.failing.take().is_some() {
            tracing::warn!(
                "the replay's log in {} can be written again; nothing was lost",
                self.folder.display()
            );
        }
    }

    /// Whether the newest segment is full.
    pub(crate) fn is_full(&self) -> bool {
        self.pending.is_empty()
            && self
                .segments
                .back()
                .is_some_and(|it| it.bytes >= self.limits.segment_bytes)
    }

    /// Where the disk budget does not allow another segment: the oldest transition that may stay.
    pub(crate) fn over_budget(&self) -> Option<u64> {
        let max = self.limits.disk_bytes_max?;
        let mut bytes = self.bytes() + self.limits.segment_bytes + self.largest;
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
        let number = self.newest().number + 1;
        // The record that closes the old one comes first.
        let begun = begin_segment(&self.folder, self.id, number, self.ordinal + 1, snapshot);
        let (segment, file) = match begun {
            Ok(begun) => begun,
            Err(e) => return self.note_failing(&e),
        };
        let closed = record::head(RecordKind::Closed, self.ordinal, &[], 0);
        if let Err(e) = self.write(&closed, &[]) {
            // Without it the new one is one too many.
            remove(&segment::path(&self.folder, number));
            return self.note_failing(&e);
        }
        self.ordinal += 2;
        self.file = file.clone();
        self.syncer.opened(number, file);
        self.segments.push_back(segment);
    }

    /// Begins another segment with `snapshot`, which is on the disk when this returns.
    pub(super) fn mark(&mut self, snapshot: &Snapshot) -> Result<Mark, PersistError> {
        let before = self.newest().number;
        if self.is_ready() {
            self.rotate(snapshot);
        }
        let number = self.newest().number;
        if number == before {
            let full = io::Error::other("it refuses to be written, as the log says");
            return Err(io_error("marking", &self.folder)(full));
        }
        self.syncer
            .flushed()
            .map_err(io_error("flushing", &self.folder))?;
        Ok(Mark::at(number))
    }

    /// Removes the oldest segments, whose transitions are all before `oldest_row`, as far as they come before segment `keep`.
    pub(super) fn prune(&mut self, oldest_row: u64, keep: u64) {
        while self.segments.len() > 1
            && self.segments[1].first_row <= oldest_row
            && self.segments[0].number < keep
        {
            let number = self.segments[0].number;
            self.syncer.removed(number);
            if !remove(&segment::path(&self.folder, number)) {
                return;
            }
            self.segments.pop_front();
        }
    }
}

/// A new segment whose only record has the number `ordinal`; nothing stays if it cannot be written.
fn begin_segment(
    folder: &Path,
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
    let path = segment::path(folder, number);
    let file = File::create(&path)?;
    if let Err(e) = file.write_all_at(&head, 0) {
        remove(&path);
        return Err(e);
    }
    let segment = Segment {
        number,
        first_row: snapshot.inserted,
        bytes: head.len() as u64,
    };
    Ok((segment, Arc::new(file)))
}

/// Removes a file; if that fails it is tried again, or does no harm.
fn remove(path: &Path) -> bool {
    match fs::remove_file(path) {
        Err(e) if e.kind() != io::ErrorKind::NotFound => {
            tracing::debug!("removing {}: {e}", path.display());
            false
        }
        _ => true,
    }
}
