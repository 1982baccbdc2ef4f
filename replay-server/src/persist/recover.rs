//! Reads a log back: the replay as it was when the last whole record was written, and what of it is damaged or missing.
//! Transitions come back through the code that stored them; what is gone leaves a gap that no row of a batch reaches into.

use std::{
    fs, io,
    path::Path,
    time::{Duration, Instant},
};

use driml_protocol::{BufferPool, Chunk, codec};

use super::{
    error::PersistError,
    folder::{LogFolder, io_error},
    journal::Place,
    progress::Reading,
    record::{Broken, Record, RecordKind, RecordReader},
    segment::{self, LogId, Mark, SegmentFile, SegmentHeader},
    snapshot::Note,
};
use crate::{replay::Replay, storage::frame_store::Packer};

/// How often it is logged how far the reading is.
const SAY: Duration = Duration::from_secs(5);

/// What was found in the folder of a log.
#[derive(Clone, Debug, Default)]
pub struct Recovery {
    /// There was a replay.
    pub found: bool,
    /// Bytes of the log that were read.
    pub bytes: u64,
    /// How long that took.
    pub took: Duration,
    /// Damage, and what came of it: sentences for a person.
    pub warnings: Vec<String>,
}

/// A log on its way back into a replay.
struct Reader<'a> {
    folder: &'a LogFolder,
    id: LogId,
    replay: &'a mut Replay,
    packer: Packer,
    pool: BufferPool,
    place: Place,
    recovery: Recovery,
    /// The oldest transition that was held, as far as records say.
    oldest: u64,
    /// Whether which transitions are held follows from their number, as it did before.
    same_capacity: bool,
    /// The last that the log says, if it is a mark: then all is brought back.
    mark: Option<Mark>,
}

/// Removes what the log in `folder` says after `mark`.
pub(super) fn go_back(folder: &LogFolder, mark: Mark) -> Result<(), PersistError> {
    let files = folder.segments()?;
    let Some(marked) = files.iter().find(|it| it.number == mark.segment()) else {
        return Err(PersistError::NoMark(segment::path(
            &folder.path,
            mark.segment(),
        )));
    };
    let reading = || io_error("reading", &marked.path);
    let mut reader = RecordReader::open(&marked.path).map_err(reading())?;
    let begins = matches!(
        reader.next().map_err(reading())?,
        Some(Ok(record)) if record.kind == RecordKind::Segment
    );
    if !begins {
        return Err(PersistError::NoMark(marked.path.clone()));
    }
    // The newest first: what is left at any moment is a log that ends earlier.
    for later in files.iter().rev() {
        if later.number > mark.segment() {
            fs::remove_file(&later.path).map_err(io_error("removing", &later.path))?;
        }
    }
    cut_off(marked, reader.at())
}

/// Ends a segment's file at byte `at`.
fn cut_off(file: &SegmentFile, at: u64) -> Result<(), PersistError> {
    fs::File::options()
        .write(true)
        .open(&file.path)
        .and_then(|opened| opened.set_len(at))
        .map_err(io_error("cutting off the end of", &file.path))
}

/// Rebuilds `replay`, which is empty, from the segments of log `id` in `folder`. With a `mark`, which is the last that the log says, all
/// of the replay's state is taken from there.
pub(super) fn recover(
    folder: &LogFolder,
    id: LogId,
    replay: &mut Replay,
    mark: Option<Mark>,
    reading: &Reading,
) -> Result<(Place, Recovery), PersistError> {
    let files = folder.segments()?;
    let packer = replay.packer();
    replay.quiet = true;
    let mut reader = Reader {
        folder,
        id,
        replay,
        packer,
        pool: BufferPool::new(2),
        place: Place {
            number: files.last().map_or(0, |it| it.number + 1),
            ..Place::default()
        },
        recovery: Recovery::default(),
        oldest: 0,
        same_capacity: false,
        mark,
    };
    let bytes = |file: &SegmentFile| fs::metadata(&file.path).map_or(0, |it| it.len());
    let total: u64 = files.iter().map(bytes).sum();
    let dir = folder.path.display();
    if !files.is_empty() {
        tracing::info!(
            "reads the replay in {dir}: {} segments, {} MiB; requests are answered with its progress",
            files.len(),
            total >> 20
        );
    }
    reading.set_bytes(total);
    let mut due = Instant::now() + SAY;
    for (at, file) in files.iter().enumerate() {
        if Instant::now() > due {
            due += SAY;
            tracing::info!("reads the replay in {dir}: {}", reading.progress());
        }
        if reading.is_stopped() {
            return Err(PersistError::Stopped);
        }
        let of_it = bytes(file);
        reader.read_segment(file, at + 1 == files.len())?;
        reading.add_read(of_it);
    }
    reader.finish()
}

/// Which log the newest segment in `folder` that can be read is of; none if there is none.
pub(super) fn find_id(folder: &LogFolder) -> Result<Option<LogId>, PersistError> {
    let files = folder.segments()?;
    for file in files.iter().rev() {
        let mut reader = RecordReader::open(&file.path).map_err(io_error("reading", &file.path))?;
        let first = reader.next().map_err(io_error("reading", &file.path))?;
        if let Some(Ok(record)) = first
            && let Ok(header) = codec::decode_value::<SegmentHeader>(record.body)
        {
            return Ok(Some(header.log));
        }
    }
    Ok(None)
}

impl Reader<'_> {
    fn warn(&mut self, text: String) {
        self.recovery.warnings.push(text);
    }

    /// Whether `ordinal` may be that of the next record, after none or some that are missing.
    const fn may_follow(&self, ordinal: u64) -> bool {
        !self.recovery.found || ordinal >= self.place.ordinal
    }

    fn read_segment(&mut self, file: &SegmentFile, is_last: bool) -> Result<(), PersistError> {
        let name = file_name(&file.path);
        let reading = || io_error("reading", &file.path);
        let mut reader = RecordReader::open(&file.path).map_err(reading())?;
        let begins = match reader.next().map_err(reading())? {
            Some(Ok(record)) if record.kind == RecordKind::Segment => {
                let header = codec::decode_value::<SegmentHeader>(record.body);
                header.ok().map(|header| (header, record.ordinal))
            }
            Some(Err(Broken::Torn)) | None if is_last => {
                // The server ended while it began this one; nothing is in it.
                return fs::remove_file(&file.path).map_err(io_error("removing", &file.path));
            }
            _ => None,
        };
        let Some((header, ordinal)) = begins else {
            self.set_aside(file, "its beginning is damaged");
            return Ok(());
        };
        let unusable = |why: String| {
            PersistError::Unusable(file.path.clone(), format!("cannot be used: {why}"))
        };
        let snapshot = header.snapshot;
        if header.log != self.id {
            self.warn(format!("{name} is not of this log and was left unchanged"));
            return Ok(());
        }
        if header.number != file.number || !self.may_follow(ordinal) {
            self.set_aside(file, "it is not the segment that belongs here");
            return Ok(());
        }
        let is_mark = self.mark.is_some_and(|mark| mark.segment() == file.number);
        let is_prioritised = self.replay.config.sampling.is_prioritised();
        if is_mark && snapshot.rows.is_prioritised() != is_prioritised {
            let why = "replay.sampling is another rule than it was".into();
            return Err(unusable(why));
        }
        let (stored, first_row) = (self.replay.ring.inserted(), snapshot.inserted);
        let is_first = !self.recovery.found;
        self.oldest = snapshot.oldest;
        self.same_capacity = snapshot.capacity == self.replay.ring.capacity()
            && self.replay.config.compressed_bytes_max.is_none();
        self.replay.restore(snapshot).map_err(unusable)?;
        if !is_first && first_row > stored {
            self.warn(format!(
                "the transitions {stored} to {} are gone: something before {name} is damaged or missing. All others are there, and all \
                 counts are right",
                first_row - 1
            ));
        }
        self.recovery.found = true;
        self.place.ordinal = ordinal + 1;
        self.place.segments.push((file.clone(), first_row));
        let ended = self.read_records(&mut reader).map_err(reading())?;
        let at = reader.at();
        self.recovery.bytes += at;
        let cut = reader.length() - at;
        match ended {
            Ok(is_closed) if is_closed && is_last => self.warn(format!(
                "the segment after {name} is missing: the replay is what it was when that one began; what was stored and served since is lost"
            )),
            Ok(_) => {}
            Err(broken) if is_last => self.cut(file, at, cut, &broken)?,
            Err(_) => self.warn(format!(
                "{name} is damaged at byte {at}: {cut} bytes of it are of no use"
            )),
        }
        Ok(())
    }

    /// Ends the last segment where its last whole record ends.
    fn cut(
        &mut self,
        file: &SegmentFile,
        at: u64,
        cut: u64,
        broken: &Broken,
    ) -> Result<(), PersistError> {
        let name = file_name(&file.path);
        match broken {
            // No actor was told that it is stored.
            Broken::Torn => tracing::info!(
                "the last record of {name} was not written whole: its {cut} bytes are cut off"
            ),
            Broken::Damaged => self.warn(format!(
                "{name} is damaged at byte {at}: the {cut} bytes from there on are cut off, as nothing after them can be trusted. What was stored \
                 and served then is lost"
            )),
        }
        cut_off(file, at)
    }

    /// Gives a segment that cannot be used another name.
    fn set_aside(&mut self, file: &SegmentFile, why: &str) {
        let name = file_name(&file.path);
        let aside = file.path.with_extension("unusable");
        let renamed = fs::rename(&file.path, &aside);
        let so = match renamed {
            Ok(()) => format!("it is now {}", file_name(&aside)),
            Err(e) => format!("it stays there, as it cannot be renamed: {e}"),
        };
        self.warn(format!("{name} cannot be used, {why}: {so}"));
    }

    /// Takes the records of a segment: whether the last one says that another segment follows, or why the rest is of no use.
    fn read_records(&mut self, reader: &mut RecordReader) -> io::Result<Result<bool, Broken>> {
        let mut is_closed = false;
        loop {
            // So that the reader ends before a record that says what cannot be.
            let before = reader.at();
            let record = match reader.next()? {
                None => return Ok(Ok(is_closed)),
                Some(Err(broken)) => return Ok(Err(broken)),
                Some(Ok(record)) => record,
            };
            let applied = match !is_closed && record.ordinal == self.place.ordinal {
                true => self.apply(&record),
                false => Err("it is not the next one".into()),
            };
            if let Err(why) = applied {
                tracing::debug!("record {}: {why}", record.ordinal);
                reader.go_back_to(before);
                return Ok(Err(Broken::Damaged));
            }
            self.place.ordinal += 1;
            is_closed = record.kind == RecordKind::Closed;
        }
    }

    fn apply(&mut self, record: &Record<'_>) -> Result<(), String> {
        match record.kind {
            RecordKind::Closed => Ok(()),
            RecordKind::Segment => Err("a segment begins within another".into()),
            RecordKind::Chunk => {
                let (hash, len) = (self.id.spec_hash, record.body.len());
                let num_actions = self.replay.spec.num_actions;
                let chunk = Chunk::receive([record.body], len, &self.pool, hash, num_actions)
                    .map_err(|e| e.to_string())?;
                if let Some(why) = self.replay.unfit(&chunk) {
                    return Err(why);
                }
                self.replay.state.actors.check_known(&chunk.header)?;
                let packed = self.packer.pack(std::borrow::Cow::Owned(chunk));
                self.replay.store(&packed);
                Ok(())
            }
            RecordKind::Note => {
                match codec::decode_value(record.body).map_err(|e| e.to_string())? {
                    Note::ActorJoined(join) => self.replay.join_actor(join).map(drop),
                    Note::Goodbye(goodbye) => self.replay.goodbye(&goodbye).map_or(Ok(()), Err),
                    Note::LearnerJoined(join) => self.replay.join_learner(join).map(drop),
                }
            }
        }
    }

    fn finish(mut self) -> Result<(Place, Recovery), PersistError> {
        if !self.recovery.found && !self.recovery.warnings.is_empty() {
            let why = self.recovery.warnings.join("; ");
            let why = format!(
                "cannot be used: no segment can be read ({why}); to begin a new replay there, remove them"
            );
            return Err(PersistError::Unusable(self.folder.path.clone(), why));
        }
        // Older segments are removed once none of their transitions is held.
        let ring = &self.replay.ring;
        let (first, end) = (ring.first(), ring.inserted());
        let held_from = self.oldest.max(end.saturating_sub(ring.capacity()));
        if self.same_capacity && held_from < first {
            self.warn(format!(
                "the transitions {held_from} to {} are gone: the oldest segments are missing. All others are there, and all counts are right",
                first - 1
            ));
        }
        self.replay.quiet = false;
        if self.recovery.found && self.mark.is_none() {
            self.replay.await_learner();
        }
        Ok((self.place, self.recovery))
    }
}

fn file_name(path: &Path) -> String {
    path.file_name()
        .map_or_else(String::new, |name| name.to_string_lossy().into_owned())
}
