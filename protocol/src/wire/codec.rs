//! The bytes of a message: a fixed prefix, a bincode header, then a raw payload that serde never touches.
//! It does not know what a message means; it alone calls bincode for what travels.

use std::io::Read;

use bincode::config::{Configuration, Fixint, LittleEndian};
use serde::{Deserialize, Serialize, de::DeserializeOwned};

use super::{
    buffers::{Buffer, BufferPool},
    error::CodecError,
    message::Message,
};

/// The version of every message in this crate; processes of different versions reject each other.
pub const PROTOCOL_VERSION: u16 = 8;

/// Length of the fixed prefix, bytes: the widths of its fields.
pub const PREFIX_BYTES: usize = 32;
/// Longest header, bytes; a longer one is refused by both sides.
pub const HEADER_BYTES_MAX: usize = 1 << 20;
/// Longest payload, bytes; a longer one is refused by both sides.
pub const PAYLOAD_BYTES_MAX: usize = 1 << 29;

/// Bytes that are copied, then summed while they are in the nearest cache.
const BLOCK_BYTES: usize = 1 << 14;

/// Longest value of [`encode_value`], bytes.
pub const VALUE_BYTES_MAX: usize = 1 << 28;

/// The prefix's integers: of fixed width, without gaps.
const FIXED: Configuration<LittleEndian, Fixint> =
    bincode::config::standard().with_fixed_int_encoding();

fn encode_within<T: Serialize>(value: &T, max: usize) -> Result<Vec<u8>, CodecError> {
    let bytes = bincode::serde::encode_to_vec(value, bincode::config::standard())
        .map_err(|e| CodecError::Header(e.to_string()))?;
    CodecError::check_size(bytes.len(), max)?;
    Ok(bytes)
}

/// The value of all of `bytes`, which claims no more than `MAX` bytes of memory.
fn decode_within<T: DeserializeOwned, const MAX: usize>(bytes: &[u8]) -> Result<T, CodecError> {
    let config = bincode::config::standard().with_limit::<MAX>();
    let (value, used) = bincode::serde::decode_from_slice(bytes, config)
        .map_err(|e| CodecError::Header(e.to_string()))?;
    match bytes.len() - used {
        0 => Ok(value),
        over => Err(CodecError::Header(format!("{over} bytes after its end"))),
    }
}

/// The bytes of a value that travels in no message, for files and hashes.
pub fn encode_value<T: Serialize>(value: &T) -> Result<Vec<u8>, CodecError> {
    encode_within(value, VALUE_BYTES_MAX)
}

/// Reads what [`encode_value`] wrote. That the bytes are undamaged is the caller's to check.
pub fn decode_value<T: DeserializeOwned>(bytes: &[u8]) -> Result<T, CodecError> {
    decode_within::<T, VALUE_BYTES_MAX>(bytes)
}

/// Prefix and header of a message; the wire carries these bytes followed by `payload`, which is not copied.
pub fn seal<M: Message>(
    spec_hash: u64,
    message: &M,
    payload: &[u8],
) -> Result<Vec<u8>, CodecError> {
    CodecError::check_size(payload.len(), PAYLOAD_BYTES_MAX)?;
    let header = encode_within(message, HEADER_BYTES_MAX)?;
    let mut prefix = Prefix {
        magic: Prefix::MAGIC,
        version: PROTOCOL_VERSION,
        kind: M::KIND,
        spec_hash,
        header_bytes: header.len() as u32,
        payload_bytes: payload.len() as u64,
        checksum: 0,
    };
    let mut sum = prefix.checksum_begun();
    sum.update(&header);
    sum.update(payload);
    prefix.checksum = sum.finalize();
    Ok([&prefix.to_bytes()[..], &header].concat())
}

/// A whole message in one piece, for small ones and for tests.
pub fn encode<M: Message>(
    spec_hash: u64,
    message: &M,
    payload: &[u8],
) -> Result<Vec<u8>, CodecError> {
    Ok([&seal(spec_hash, message, payload)?, payload].concat())
}

/// Checks a message in one piece and gives it and its payload.
///
/// `spec_hash` is the hash of this process's run, or `None` where any run is accepted (a process that joins to learn it).
pub fn decode<M: Message>(bytes: &[u8], spec_hash: Option<u64>) -> Result<(M, &[u8]), CodecError> {
    let (message, payload) = receive(bytes, bytes.len(), &BufferPool::new(0), spec_hash)?;
    Ok((message, &bytes[bytes.len() - payload.len()..]))
}

/// Checks a message of `len` bytes and copies its payload into own memory of `pool`.
///
/// The checksum is the copy's, so what was checked cannot change afterwards, even if it came through shared memory.
pub fn receive<M: Message>(
    mut bytes: impl Read,
    len: usize,
    pool: &BufferPool,
    spec_hash: Option<u64>,
) -> Result<(M, Buffer), CodecError> {
    let mut prefix = [0; PREFIX_BYTES];
    let is_there = bytes.read_exact(&mut prefix).is_ok();
    let prefix = Prefix::read(is_there.then_some(&prefix), len)?;
    let mut sum = prefix.checksum_begun();
    let mut header = vec![0; prefix.header_len()];
    copy(&mut bytes, &mut header, &mut sum);
    let mut payload = pool.take_own(prefix.payload_len());
    copy(&mut bytes, &mut payload, &mut sum);
    let message = prefix.message(sum, &header, &payload, spec_hash)?;
    Ok((message, payload))
}

/// Copies the next bytes into `out`, a block at a time, so that the sum finds each block of the copy in the cache.
/// Where they end early, the sum will not fit.
fn copy(bytes: &mut impl Read, out: &mut [u8], sum: &mut crc32fast::Hasher) {
    for block in out.chunks_mut(BLOCK_BYTES) {
        if bytes.read_exact(block).is_err() {
            return;
        }
        sum.update(block);
    }
}

/// The first bytes of every message: each field with its width, in the order in which they travel.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
struct Prefix {
    /// `DRML`, so that strangers are told from us.
    magic: u32,
    /// The protocol's version; others are refused.
    version: u16,
    /// Which message it is: a [`Kind`](crate::Kind).
    kind: u16,
    /// The hash of the run's spec, so that runs are not mixed.
    spec_hash: u64,
    header_bytes: u32,
    payload_bytes: u64,
    /// CRC-32 of the prefix before it, the header and the payload. It stays the last field.
    checksum: u32,
}

impl Prefix {
    const MAGIC: u32 = u32::from_le_bytes(*b"DRML");

    fn to_bytes(self) -> [u8; PREFIX_BYTES] {
        let mut bytes = [0; PREFIX_BYTES];
        let written = bincode::serde::encode_into_slice(self, &mut bytes, FIXED);
        debug_assert_eq!(written.ok(), Some(PREFIX_BYTES));
        bytes
    }

    /// The fields of bytes that came, whatever they say.
    fn from_bytes(bytes: &[u8; PREFIX_BYTES]) -> Self {
        let read = bincode::serde::decode_from_slice(bytes, FIXED);
        read.expect("any 32 bytes are seven integers").0
    }

    /// A checksum over the fields before it, to which header and payload are to be added.
    fn checksum_begun(self) -> crc32fast::Hasher {
        let mut sum = crc32fast::Hasher::new();
        sum.update(&self.to_bytes()[..PREFIX_BYTES - size_of::<u32>()]);
        sum
    }

    /// The prefix of a message of `len` bytes in all, if its magic, version and lengths are in order.
    fn read(bytes: Option<&[u8; PREFIX_BYTES]>, len: usize) -> Result<Self, CodecError> {
        let this = Self::from_bytes(bytes.ok_or(CodecError::Length {
            have: len,
            need: PREFIX_BYTES,
        })?);
        if this.magic != Self::MAGIC {
            return Err(CodecError::Magic);
        }
        if this.version != PROTOCOL_VERSION {
            return Err(CodecError::Version {
                theirs: this.version,
                ours: PROTOCOL_VERSION,
            });
        }
        CodecError::check_size(this.header_len(), HEADER_BYTES_MAX)?;
        CodecError::check_size(this.payload_len(), PAYLOAD_BYTES_MAX)?;
        let need = PREFIX_BYTES + this.header_len() + this.payload_len();
        if len != need {
            return Err(CodecError::Length { have: len, need });
        }
        Ok(this)
    }

    const fn header_len(&self) -> usize {
        self.header_bytes as usize
    }

    fn payload_len(&self) -> usize {
        usize::try_from(self.payload_bytes).unwrap_or(usize::MAX)
    }

    /// The message, if its checksum, kind and run are right, and header and payload are what its type promises.
    fn message<M: Message>(
        &self,
        sum: crc32fast::Hasher,
        header: &[u8],
        payload: &[u8],
        spec_hash: Option<u64>,
    ) -> Result<M, CodecError> {
        if sum.finalize() != self.checksum {
            return Err(CodecError::Checksum);
        }
        if self.kind != M::KIND {
            return Err(CodecError::Kind {
                theirs: self.kind,
                ours: M::KIND,
            });
        }
        if let Some(ours) = spec_hash.filter(|ours| *ours != self.spec_hash) {
            return Err(CodecError::RunSpec {
                theirs: self.spec_hash,
                ours,
            });
        }
        let message: M = decode_within::<_, HEADER_BYTES_MAX>(header)?;
        message.validate(payload)?;
        Ok(message)
    }
}
