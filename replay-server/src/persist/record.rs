//! The bytes of the log: consecutive records, each with its ordinal, its length and a checksum.
//! `snapshot` and `folder` define what a record means; `recover` decides where a segment ends.
//!
//! A record is a head of 32 bytes, little-endian, and a body:
//! magic u32, kind u32, ordinal u64, length of the body u64, bytes of the body that the checksum covers u32, crc32 u32.
//! The checksum also covers the head before it. The body of a chunk record is the message as received: the checksum covers only the
//! message's head, as the message has another checksum over all of it.

const HEAD_BYTES: usize = 32;
const MAGIC: [u8; 4] = *b"DRL1";
/// Maximum bytes of a body: those of the largest message, and a margin.
const BODY_BYTES_MAX: u64 = (1 << 29) + (1 << 21);
/// Maximum valid ordinal of a record. No log reaches it.
pub(super) const ORDINAL_MAX: u64 = 1 << 60;
/// Maximum places, of those that start with the magic number, at which a record is searched for after one that seems too long.
const CANDIDATES_MAX: usize = 64;

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u32)]
pub(super) enum RecordKind {
    /// The first record of a segment: the segment's number, and the replay's state where it begins.
    Segment = 1,
    /// An actor or learner that joined, or an actor that left or was forgotten.
    Event = 2,
    /// A chunk that was stored.
    Chunk = 3,
    /// The last record of a segment that is followed by another segment.
    Closed = 4,
}

impl RecordKind {
    fn from_number(number: u32) -> Option<Self> {
        let all = [Self::Segment, Self::Event, Self::Chunk, Self::Closed];
        all.into_iter().find(|kind| *kind as u32 == number)
    }
}

/// Returns the head of a record, followed by `checked`, the part of its body that the checksum covers. `rest` bytes of body come after it.
pub(super) fn encode_head(kind: RecordKind, ordinal: u64, checked: &[u8], rest: usize) -> Vec<u8> {
    let length = (checked.len() + rest) as u64;
    let mut head = Vec::with_capacity(HEAD_BYTES + checked.len());
    head.extend_from_slice(&MAGIC);
    head.extend_from_slice(&(kind as u32).to_le_bytes());
    head.extend_from_slice(&ordinal.to_le_bytes());
    head.extend_from_slice(&length.to_le_bytes());
    head.extend_from_slice(&(checked.len() as u32).to_le_bytes());
    let sum = checksum(&head, checked);
    head.extend_from_slice(&sum.to_le_bytes());
    head.extend_from_slice(checked);
    head
}

#[derive(Debug)]
pub(super) struct Record<'a> {
    pub(super) kind: RecordKind,
    pub(super) ordinal: u64,
    pub(super) body: &'a [u8],
}

impl Record<'_> {
    pub(super) const fn bytes(&self) -> usize {
        HEAD_BYTES + self.body.len()
    }
}

#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum RecordError {
    /// The last record was not written whole.
    Torn,
    /// Bytes that are not a record, followed by others.
    Damaged,
    /// A chunk that this replay cannot hold, and why.
    Misfit(String),
}

impl RecordError {
    const fn torn_if(is_torn: bool) -> Self {
        if is_torn { Self::Torn } else { Self::Damaged }
    }
}

/// Returns the checksum of a record, over its head and `checked`, the first part of its body.
fn checksum(head: &[u8], checked: &[u8]) -> u32 {
    let mut sum = crc32fast::Hasher::new();
    sum.update(&head[..HEAD_BYTES - 4]);
    sum.update(checked);
    sum.finalize()
}

fn read_u32(head: &[u8; HEAD_BYTES], at: usize) -> u32 {
    u32::from_le_bytes([head[at], head[at + 1], head[at + 2], head[at + 3]])
}

/// Reads the first record in `rest`, the remaining bytes of a segment.
pub(super) fn read_first(rest: &[u8]) -> Result<Record<'_>, RecordError> {
    let Some((head, after)) = rest.split_first_chunk::<HEAD_BYTES>() else {
        return Err(RecordError::Torn);
    };
    let is_zero = |bytes: &[u8]| bytes.iter().all(|&byte| byte == 0);
    let read_u32 = |at| read_u32(head, at);
    let read_u64 = |at| u64::from(read_u32(at)) | u64::from(read_u32(at + 4)) << 32;
    let (ordinal, body_bytes, checked) = (read_u64(8), read_u64(16), read_u32(24));
    let is_sane = rest.starts_with(&MAGIC)
        && ordinal <= ORDINAL_MAX
        && body_bytes <= BODY_BYTES_MAX
        && u64::from(checked) <= body_bytes;
    let Some(kind) = RecordKind::from_number(read_u32(4)).filter(|_| is_sane) else {
        // A power cut leaves zeros where data was not written yet.
        return Err(RecordError::torn_if(is_zero(rest)));
    };
    let Some((body, others)) = after.split_at_checked(body_bytes as usize) else {
        // If another record follows, the length of this one is wrong.
        return Err(RecordError::torn_if(!contains_record(after)));
    };
    if checksum(head, &body[..checked as usize]) != read_u32(28) {
        return Err(RecordError::torn_if(is_zero(others)));
    }
    Ok(Record {
        kind,
        ordinal,
        body,
    })
}

/// Whether a record whose checksum is right begins somewhere in `bytes`.
fn contains_record(bytes: &[u8]) -> bool {
    let begins = (0..bytes.len()).filter(|&at| bytes[at..].starts_with(&MAGIC));
    begins.take(CANDIDATES_MAX).any(|at| {
        let Some((head, after)) = bytes[at..].split_first_chunk::<HEAD_BYTES>() else {
            return false;
        };
        let checked = after.get(..read_u32(head, 24) as usize);
        checked.is_some_and(|checked| checksum(head, checked) == read_u32(head, 28))
    })
}
