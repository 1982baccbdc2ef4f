//! Reads a log back: the replay as it was when the last whole record was written, and what of it is damaged or missing.
//! Transitions come back through the code that stored them; what is gone leaves a gap that no row of a batch reaches into.

use std::{
    fs, io,
    path::Path,
    time::{Duration, Instant},
};

use driml_protocol::{BufferPool, Chunk, codec};

use super::{
    error::DurableError,
    folder::{LogFolder, io_error},
    progress::Reading,
    record::{self, Broken, Record, RecordKind, RecordReader},
    segment::{self, LogId, Mark, SegmentFile, SegmentHeader},
};
use crate::{
    replay::{Replay, events::Event},
    storage::frame_store::Packer,
};

/// How often it is logged how far the reading is.
const SAY: Duration = Duration::from_secs(5);

/// Where a log goes on, and what was found on the way there.
pub(super) struct Recovered {
    /// The segments that are of use, each with its first transition.
    pub(super) segments: Vec<(SegmentFile, u64)>,
    /// Number of the next segment.
    pub(super) number: u64,
    /// Number of the next record.
    pub(super) ordinal: u64,
    pub(super) learner: Option<u64>,
    pub(super) after_updates: u64,
    /// Bytes of the records that were read.
    pub(super) bytes: u64,
    /// What a person should know: damage, and what came of it.
    pub(super) warnings: Vec<String>,
}

impl Recovered {
    /// Nothing was found: a log begins with segment `number`.
    pub(super) const fn nothing(number: u64, after_updates: u64) -> Self {
        Self {
            segments: Vec::new(),
            number,
            ordinal: 0,
            learner: None,
            after_updates,
            bytes: 0,
            warnings: Vec::new(),
        }
    }
}

/// How the records of one segment ended.
#[derive(Debug)]
enum SegmentEnd {
    /// With its last byte; whether it says that another one follows.
    Whole { closed: bool },
    /// Before: the rest is of no use.
    Broken(Broken),
}

struct Recovery<'a> {
    folder: &'a LogFolder,
    id: LogId,
    replay: &'a mut Replay,
    packer: Packer,
    pool: BufferPool,
    num_actions: u32,
    found: Recovered,
    /// Number of the next record; none before the first.
    expected: Option<u64>,
    are_listed: bool,
    /// The oldest transition that was held, as far as records say.
    oldest: u64,
    /// Whether which transitions are held follows from their number, as it did before.
    same_capacity: bool,
    /// The last that the log says, if it is a mark.
    mark: Option<Mark>,
}

/// Removes what the log in `folder` says after `mark`.
pub(super) fn go_back(folder: &LogFolder, mark: Mark) -> Result<(), DurableError> {
    let files = segment::list(&folder.path).map_err(io_error("listing", &folder.path))?;
    let Some(marked) = files.iter().find(|it| it.number == mark.segment()) else {
        return Err(DurableError::NoMark(segment::path(
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
        return Err(DurableError::NoMark(marked.path.clone()));
    }
    // The newest first: whatever is left then is a log that ends earlier.
    for later in files.iter().rev() {
        if later.number > mark.segment() {
            fs::remove_file(&later.path).map_err(io_error("removing", &later.path))?;
        }
    }
    cut_off(marked, reader.at())
}

/// Ends a segment's file at byte `at`.
fn cut_off(file: &SegmentFile, at: u64) -> Result<(), DurableError> {
    fs::File::options()
        .write(true)
        .open(&file.path)
        .and_then(|opened| opened.set_len(at))
        .map_err(io_error("cutting off the end of", &file.path))
}

/// Rebuilds `replay`, which is empty, from the segments in `folder`; `None` if there are none of log `id`. With a `mark`, which is
/// the last that the log says, all of the replay's state is taken from there.
pub(super) fn recover(
    folder: &LogFolder,
    id: LogId,
    num_actions: u32,
    replay: &mut Replay,
    mark: Option<Mark>,
    reading: &Reading,
) -> Result<Option<Recovered>, DurableError> {
    let files = segment::list(&folder.path).map_err(io_error("listing", &folder.path))?;
    let number = files.last().map_or(0, |it| it.number + 1);
    let packer = replay.packer();
    let mut recovery = Recovery {
        folder,
        id,
        replay,
        packer,
        pool: record::pool(),
        num_actions,
        found: Recovered {
            segments: Vec::new(),
            number,
            ordinal: 0,
            learner: None,
            after_updates: 0,
            bytes: 0,
            warnings: Vec::new(),
        },
        expected: None,
        are_listed: false,
        oldest: 0,
        same_capacity: false,
        mark,
    };
    let last = files.len().saturating_sub(1);
    let bytes = |file: &SegmentFile| fs::metadata(&file.path).map_or(0, |it| it.len());
    let total: u64 = files.iter().map(bytes).sum();
    let dir = folder.path.display();
    tracing::info!(
        "reads the replay in {dir}: {} segments, {} MiB; whoever asks hears how far it is",
        files.len(),
        total >> 20
    );
    reading.set_bytes(total);
    let mut due = Instant::now() + SAY;
    for (at, file) in files.iter().enumerate() {
        if Instant::now() > due {
            due += SAY;
            tracing::info!("reads the replay in {dir}: {}", reading.progress());
        }
        if reading.is_stopped() {
            return Err(DurableError::Stopped);
        }
        let of_it = bytes(file);
        recovery.read_segment(file, at == last)?;
        reading.add_read(of_it);
    }
    recovery.finish()
}

/// Which log the newest segment in `folder` that can be read is of; none if there is none.
pub(super) fn find_id(folder: &LogFolder) -> Result<Option<LogId>, DurableError> {
    let files = segment::list(&folder.path).map_err(io_error("listing", &folder.path))?;
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

impl Recovery<'_> {
    fn warn(&mut self, text: String) {
        self.found.warnings.push(text);
    }

    fn read_segment(&mut self, file: &SegmentFile, is_last: bool) -> Result<(), DurableError> {
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
        let state = header.state;
        if header.log != self.id {
            self.warn(format!("{name} is not of this log and was left as it is"));
            return Ok(());
        }
        if header.number != file.number || self.expected.is_some_and(|next| ordinal < next) {
            self.set_aside(file, "it is not the segment that belongs here");
            return Ok(());
        }
        let is_mark = self.mark.is_some_and(|mark| mark.segment() == file.number);
        let stored = self.replay.next_row();
        let first_row = state.replay.inserted;
        match self.expected {
            Some(expected) if expected == ordinal && !is_mark => {}
            expected => {
                self.oldest = state.replay.oldest;
                self.same_capacity = state.replay.capacity == self.replay.capacity()
                    && self.replay.holds_by_number();
                self.are_listed = state.replay.are_listed;
                (self.found.learner, self.found.after_updates) =
                    (state.learner, state.after_updates);
                let gap = self.replay.restore(state.replay).map_err(|why| {
                    let path = file.path.clone();
                    DurableError::State { path, why }
                })?;
                if expected.is_some() && first_row > stored {
                    self.are_listed = false;
                    self.warn(format!(
                        "the transitions {stored} to {} are gone ({gap} of those that were held): something before {name} is damaged or missing. \
                         All others are there, and all counts are right",
                        first_row - 1
                    ));
                }
            }
        }
        self.expected = Some(ordinal + 1);
        self.found.segments.push((file.clone(), first_row));
        let ended = self.read_records(&mut reader).map_err(reading())?;
        self.found.bytes += reader.at();
        let cut = reader.length() - reader.at();
        match ended {
            SegmentEnd::Whole { closed: true } if is_last => self.warn(format!(
                "the segment after {name} is missing: the replay is what it was when that one began; what was stored and served since is lost"
            )),
            SegmentEnd::Whole { .. } => {}
            SegmentEnd::Broken(broken) => {
                let at = reader.at();
                if is_last {
                    self.cut(file, at, cut, &broken)?;
                } else {
                    self.warn(format!("{name} is damaged at byte {at}: {cut} bytes of it are of no use"));
                }
            }
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
    ) -> Result<(), DurableError> {
        let name = file_name(&file.path);
        match broken {
            // Nobody was told that it is stored.
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

    fn read_records(&mut self, reader: &mut RecordReader) -> io::Result<SegmentEnd> {
        let mut closed = false;
        loop {
            // So that the reader ends before a record that says what cannot be.
            let before = reader.at();
            match reader.next()? {
                None => return Ok(SegmentEnd::Whole { closed }),
                Some(Err(broken)) => return Ok(SegmentEnd::Broken(broken)),
                Some(Ok(record)) => {
                    let is_next = !closed && Some(record.ordinal) == self.expected;
                    let applied = if is_next {
                        self.apply(&record)
                    } else {
                        Err(format!("record {} is not the next one", record.ordinal))
                    };
                    match applied {
                        Ok(()) => {
                            self.expected = Some(record.ordinal + 1);
                            closed = record.kind == RecordKind::Closed;
                        }
                        Err(why) => {
                            tracing::debug!("record {}: {why}", record.ordinal);
                            reader.go_back_to(before);
                            return Ok(SegmentEnd::Broken(Broken::Damaged));
                        }
                    }
                }
            }
        }
    }

    fn apply(&mut self, record: &Record<'_>) -> Result<(), String> {
        match record.kind {
            RecordKind::Closed => Ok(()),
            RecordKind::Segment => Err("a segment begins within another".into()),
            RecordKind::Chunk => {
                let (hash, len) = (self.id.spec_hash, record.body.len());
                let chunk = Chunk::receive([record.body], len, &self.pool, hash, self.num_actions)
                    .map_err(|e| e.to_string())?;
                let packed = self.packer.pack(std::borrow::Cow::Owned(chunk));
                self.are_listed = false;
                self.replay.apply_chunk(&packed)
            }
            RecordKind::Event => {
                let event = codec::decode_value(record.body).map_err(|e| e.to_string())?;
                self.apply_event(event)
            }
        }
    }

    fn apply_event(&mut self, event: Event) -> Result<(), String> {
        match event {
            Event::ActorJoined(join) => self.replay.join_actor(join).map(drop),
            Event::Goodbye(goodbye) => self.replay.goodbye(&goodbye).map_or(Ok(()), Err),
            Event::LearnerStarted {
                learner,
                rows_sampled,
            } => {
                self.found.learner = Some(learner);
                self.replay.learner_starts(rows_sampled)
            }
            Event::Affinity(update) => self.replay.set_affinity(&update).map_err(|e| e.to_string()),
            Event::OtherShards(tally) => {
                self.replay.apply_other_shards(tally);
                Ok(())
            }
            Event::Drawn(drawn) => {
                self.are_listed = self.replay.apply_drawn(&drawn)?;
                Ok(())
            }
            Event::Forgotten { oldest } => {
                self.are_listed = false;
                self.oldest = self.oldest.max(oldest);
                self.replay.forget_before(oldest);
                Ok(())
            }
            Event::ServedBefore { rows } => {
                self.replay.count_served_before(rows);
                Ok(())
            }
            Event::ActorsForgotten(actors) => {
                self.replay.forget_actors(&actors);
                Ok(())
            }
        }
    }

    fn finish(mut self) -> Result<Option<Recovered>, DurableError> {
        let Some(ordinal) = self.expected else {
            if !self.found.warnings.is_empty() {
                let why = self.found.warnings.join("; ");
                let path = self.folder.path.clone();
                return Err(DurableError::State {
                    path,
                    why: format!(
                        "no segment can be read ({why}): to begin a new replay there, remove them"
                    ),
                });
            }
            return Ok(None);
        };
        // Older segments are removed once none of their transitions is held.
        let (first, end) = (self.replay.first_row(), self.replay.next_row());
        let held_from = self.oldest.max(end.saturating_sub(self.replay.capacity()));
        if self.same_capacity && held_from < first {
            self.warn(format!(
                "the transitions {held_from} to {} are gone: the oldest segments are missing. All others are there, and all counts are right",
                first - 1
            ));
        }
        self.replay.restored(self.are_listed);
        self.found.ordinal = ordinal;
        Ok(Some(self.found))
    }
}

fn file_name(path: &Path) -> String {
    path.file_name()
        .map_or_else(String::new, |name| name.to_string_lossy().into_owned())
}
