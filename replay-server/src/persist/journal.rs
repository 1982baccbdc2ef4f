//! The log as it is written: records at the end of the newest segment, new segments, and the oldest removed.
//! What is in a record, and when one is due, is for `mod`; it reads nothing back.

use std::{
    collections::VecDeque,
    fs::{self, File},
    io,
    os::unix::fs::FileExt,
    path::PathBuf,
    sync::Arc,
    time::{Duration, Instant},
};

use driml_protocol::{LogStatus, Seldom, codec};

use super::{
    error::PersistError,
    folder::io_error,
    record::{self, RecordKind},
    segment::{self, LogId, Mark, SegmentHeader},
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

/// Which log it is, and where it goes on.
pub(super) struct Place {
    pub(super) folder: PathBuf,
    pub(super) id: LogId,
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
    /// Continues after `older` segments, each with its first transition, in a new one that begins with `snapshot`.
    pub(super) fn begin(
        place: Place,
        older: &[(segment::SegmentFile, u64)],
        limits: Limits,
        fsync: Duration,
        snapshot: &Snapshot,
    ) -> Result<Self, PersistError> {
        let Place {
            folder,
            id,
            number,
            ordinal,
        } = place;
        let mut segments = VecDeque::new();
        for (file, first_row) in older {
            let bytes = fs::metadata(&file.path)
                .map_err(io_error("looking at", &file.path))?
                .len();
            segments.push_back(Segment {
                number: file.number,
                first_row: *first_row,
                bytes,
            });
        }
        let syncer = File::open(&folder)
            .and_then(|opened| Syncer::start(opened, fsync))
            .map_err(io_error("opening", &folder))?;
        let path = segment::path(&folder, number);
        let first_row = snapshot.inserted;
        let head = header_record(id, number, ordinal, snapshot)?;
        let file = new_file(&path, &head).map_err(io_error("writing", &path))?;
        segments.push_back(Segment {
            number,
            first_row,
            bytes: head.len() as u64,
        });
        syncer.opened(number, file.clone());
        Ok(Self {
            folder,
            id,
            segments,
            file,
            ordinal: ordinal + 1,
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
    pub(super) fn append_note(&mut self, note: &Note) -> Result<(), PersistError> {
        let body = codec::encode_value(note)?;
        let record = record::head(RecordKind::Note, self.ordinal, &body, 0);
        self.ordinal += 1;
        if !self.is_ready() {
            self.pending.extend_from_slice(&record);
        } else if let Err(e) = self.write(&record, &[]) {
            self.pending = record;
            self.note_failing(&e);
        }
        Ok(())
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
    pub(super) fn rotate(&mut self, snapshot: &Snapshot) -> Result<(), PersistError> {
        let number = self.newest().number + 1;
        let path = segment::path(&self.folder, number);
        let first_row = snapshot.inserted;
        // The record that closes the old one comes first.
        let head = header_record(self.id, number, self.ordinal + 1, snapshot)?;
        match new_file(&path, &head) {
            Ok(file) => {
                let closed = record::head(RecordKind::Closed, self.ordinal, &[], 0);
                if let Err(e) = self.write(&closed, &[]) {
                    // Without it the new one is one too many.
                    self.note_failing(&e);
                    if let Err(e) = fs::remove_file(&path) {
                        tracing::debug!("removing {}: {e}", path.display());
                    }
                    return Ok(());
                }
                self.ordinal += 2;
                self.file = file.clone();
                self.syncer.opened(number, file);
                self.segments.push_back(Segment {
                    number,
                    first_row,
                    bytes: head.len() as u64,
                });
            }
            Err(e) => self.note_failing(&e),
        }
        Ok(())
    }

    /// Begins another segment with `snapshot`, which is on the disk when this returns.
    pub(super) fn mark(&mut self, snapshot: &Snapshot) -> Result<Mark, PersistError> {
        let before = self.newest().number;
        if self.is_ready() {
            self.rotate(snapshot)?;
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
            let path = segment::path(&self.folder, number);
            self.syncer.removed(number);
            match fs::remove_file(&path) {
                Err(e) if e.kind() != io::ErrorKind::NotFound => {
                    tracing::debug!("removing {}: {e}", path.display());
                    return;
                }
                _ => self.segments.pop_front(),
            };
        }
    }
}

fn header_record(
    log: LogId,
    number: u64,
    ordinal: u64,
    snapshot: &Snapshot,
) -> Result<Vec<u8>, PersistError> {
    let body = codec::encode_value(&SegmentHeader {
        log,
        number,
        snapshot: snapshot.clone(),
    })?;
    Ok(record::head(RecordKind::Segment, ordinal, &body, 0))
}

/// A new file with these bytes; nothing stays if they cannot be written.
fn new_file(path: &PathBuf, bytes: &[u8]) -> io::Result<Arc<File>> {
    let file = File::create(path)?;
    if let Err(e) = file.write_all_at(bytes, 0) {
        if let Err(e) = fs::remove_file(path) {
            tracing::debug!("removing {}: {e}", path.display());
        }
        return Err(e);
    }
    Ok(Arc::new(file))
}
