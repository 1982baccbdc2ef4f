//! The bytes of the log: records one after the other, each with its number, its length and a checksum.
//! What a record means is for `snapshot` and `segment`; where a segment ends is for `recover`.
//!
//! A record is a head of 32 bytes, little-endian, and a body:
//! magic u32, kind u32, ordinal u64, length of the body u64, bytes of the body that the checksum covers u32, crc32 u32.
//! The checksum covers the head before it too. Of a chunk, whose body is the message as it came, it covers the message's head; the
//! message has another checksum over all of it.

use std::{
    fs::File,
    io::{self, BufReader, Read},
    path::Path,
};

/// Bytes before the body.
pub(super) const HEAD_BYTES: usize = 32;
const MAGIC: u32 = u32::from_le_bytes(*b"DRL1");
/// Longest body: a message's, and some.
const BODY_BYTES_MAX: u64 = (1 << 29) + (1 << 21);
/// Highest number of a record that is believed: no log has so many.
const ORDINAL_MAX: u64 = 1 << 60;
/// Places at which a record is looked for after one that is too long: those that look like one.
const CANDIDATES_MAX: usize = 64;
/// Bytes read at once.
const READ_BYTES: usize = 1 << 18;

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u32)]
pub(super) enum RecordKind {
    /// The first of a segment: which one it is, and the replay's state where it begins.
    Segment = 1,
    /// Who came or went.
    Note = 2,
    /// A chunk that was stored.
    Chunk = 3,
    /// The last of a segment that another one follows.
    Closed = 4,
}

impl RecordKind {
    fn of(number: u32) -> Option<Self> {
        let all = [Self::Segment, Self::Note, Self::Chunk, Self::Closed];
        all.into_iter().find(|kind| *kind as u32 == number)
    }
}

/// Head of a record whose body is `checked` and then `rest` more bytes.
pub(super) fn head(kind: RecordKind, ordinal: u64, checked: &[u8], rest: usize) -> Vec<u8> {
    let length = (checked.len() + rest) as u64;
    let mut head = Vec::with_capacity(HEAD_BYTES + checked.len());
    head.extend_from_slice(&MAGIC.to_le_bytes());
    head.extend_from_slice(&(kind as u32).to_le_bytes());
    head.extend_from_slice(&ordinal.to_le_bytes());
    head.extend_from_slice(&length.to_le_bytes());
    head.extend_from_slice(&(checked.len() as u32).to_le_bytes());
    let sum = checksum(&head, checked);
    head.extend_from_slice(&sum.to_le_bytes());
    head.extend_from_slice(checked);
    head
}

/// A record that was read.
#[derive(Debug)]
pub(super) struct Record<'a> {
    pub(super) kind: RecordKind,
    pub(super) ordinal: u64,
    pub(super) body: &'a [u8],
}

/// Why no record follows.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum Broken {
    /// The last record was not written whole.
    Torn,
    /// Bytes that are not a record, with others after them.
    Damaged,
}

impl Broken {
    const fn torn_if(is_torn: bool) -> Self {
        if is_torn { Self::Torn } else { Self::Damaged }
    }
}

/// The u32 at byte `at` of a head.
fn number(head: &[u8; HEAD_BYTES], at: usize) -> u32 {
    u32::from_le_bytes([head[at], head[at + 1], head[at + 2], head[at + 3]])
}

/// The checksum of a record with this head, of whose body it covers `checked`.
fn checksum(head: &[u8], checked: &[u8]) -> u32 {
    let mut sum = crc32fast::Hasher::new();
    sum.update(&head[..HEAD_BYTES - 4]);
    sum.update(checked);
    sum.finalize()
}

/// Reads a segment's records from the first on.
pub(super) struct RecordReader {
    file: BufReader<File>,
    length: u64,
    /// Where the next record begins.
    at: u64,
    body: Vec<u8>,
}

impl RecordReader {
    pub(super) fn open(path: &Path) -> io::Result<Self> {
        let file = File::open(path)?;
        let length = file.metadata()?.len();
        Ok(Self {
            file: BufReader::with_capacity(READ_BYTES, file),
            length,
            at: 0,
            body: Vec::new(),
        })
    }

    /// The last record that was read does not count: nothing is read after it.
    pub(super) const fn go_back_to(&mut self, at: u64) {
        self.at = at;
    }

    /// Where the last record that was read ends.
    pub(super) const fn at(&self) -> u64 {
        self.at
    }

    pub(super) const fn length(&self) -> u64 {
        self.length
    }

    /// The next record; `None` at the end of the file.
    pub(super) fn next(&mut self) -> io::Result<Option<Result<Record<'_>, Broken>>> {
        let left = self.length - self.at;
        if left == 0 {
            return Ok(None);
        }
        let mut head = [0; HEAD_BYTES];
        if left < HEAD_BYTES as u64 {
            return Ok(Some(Err(Broken::Torn)));
        }
        self.file.read_exact(&mut head)?;
        let number = |at| number(&head, at);
        let long = |at| u64::from(number(at)) | u64::from(number(at + 4)) << 32;
        let (ordinal, body_bytes, checked) = (long(8), long(16), u64::from(number(24)));
        let kind = RecordKind::of(number(4));
        let sane = number(0) == MAGIC
            && ordinal <= ORDINAL_MAX
            && body_bytes <= BODY_BYTES_MAX
            && checked <= body_bytes;
        let Some(kind) = kind.filter(|_| sane) else {
            // A machine that lost its power leaves zeros where it had not written yet.
            let zeros = head.iter().all(|&byte| byte == 0) && self.rest_is_zero()?;
            return Ok(Some(Err(Broken::torn_if(zeros))));
        };
        if left - (HEAD_BYTES as u64) < body_bytes {
            // Where others follow, it is its length that is wrong.
            let follows = self.a_record_follows()?;
            return Ok(Some(Err(Broken::torn_if(!follows))));
        }
        self.body.resize(body_bytes as usize, 0);
        self.file.read_exact(&mut self.body)?;
        let sum = checksum(&head, &self.body[..checked as usize]);
        let end = self.at + HEAD_BYTES as u64 + body_bytes;
        if sum != number(28) {
            let last = end == self.length || self.rest_is_zero()?;
            return Ok(Some(Err(Broken::torn_if(last))));
        }
        self.at = end;
        Ok(Some(Ok(Record {
            kind,
            ordinal,
            body: &self.body,
        })))
    }

    /// Whether a whole record is somewhere in the rest.
    fn a_record_follows(&mut self) -> io::Result<bool> {
        let mut rest = Vec::new();
        self.file.read_to_end(&mut rest)?;
        let magic = MAGIC.to_le_bytes();
        let begins = (0..rest.len()).filter(|&at| rest[at..].starts_with(&magic));
        Ok(begins
            .take(CANDIDATES_MAX)
            .any(|at| begins_with_a_record(&rest[at..])))
    }

    fn rest_is_zero(&mut self) -> io::Result<bool> {
        let mut bytes = [0; 4096];
        loop {
            match self.file.read(&mut bytes)? {
                0 => return Ok(true),
                read if bytes[..read].iter().any(|&byte| byte != 0) => return Ok(false),
                _ => {}
            }
        }
    }
}

/// Whether a record whose checksum is right begins here.
fn begins_with_a_record(bytes: &[u8]) -> bool {
    let Some((head, after)) = bytes.split_first_chunk::<HEAD_BYTES>() else {
        return false;
    };
    let checked = after.get(..number(head, 24) as usize);
    checked.is_some_and(|checked| checksum(head, checked) == number(head, 28))
}
