//! The bytes of a message: a fixed prefix, a bincode header, then a raw payload that serde never touches.
//! The meaning of messages is not known here, and no other module encodes messages with bincode.

use std::io::Read;

use bincode::config::{Configuration, Fixint, LittleEndian};
use serde::{Deserialize, Serialize, de::DeserializeOwned};

use super::{
    buffers::{Buffer, BufferPool},
    error::CodecError,
    message::Message,
};

/// The version of every message in this crate; processes of different versions reject each other.
pub const PROTOCOL_VERSION: u16 = 9;

/// Length of the fixed prefix, bytes: the sum of the widths of its fields.
pub const PREFIX_BYTES: usize = 32;
/// Longest header, bytes; sender and receiver reject a longer one.
pub const HEADER_BYTES_MAX: usize = 1 << 20;
/// Longest payload, bytes; sender and receiver reject a longer one.
pub const PAYLOAD_BYTES_MAX: usize = 1 << 29;

/// Bytes that `copy_and_sum` handles at a time: it copies a block, then adds it to the checksum while it is in the nearest cache.
const BLOCK_BYTES: usize = 1 << 14;

/// Longest value of [`encode_value`], bytes; a longer one is an error.
pub const VALUE_BYTES_MAX: usize = 1 << 28;

/// The encoding of the prefix: integers of fixed width, without gaps.
const PREFIX_ENCODING: Configuration<LittleEndian, Fixint> =
    bincode::config::standard().with_fixed_int_encoding();

fn encode_within<T: Serialize>(value: &T, max: usize) -> Result<Vec<u8>, CodecError> {
    let bytes = bincode::serde::encode_to_vec(value, bincode::config::standard())
        .map_err(|e| CodecError::Header(e.to_string()))?;
    CodecError::check_size(bytes.len(), max)?;
    Ok(bytes)
}

/// Decodes a value from all of `bytes`; the value may claim at most `MAX` bytes of memory.
fn decode_within<T: DeserializeOwned, const MAX: usize>(bytes: &[u8]) -> Result<T, CodecError> {
    let config = bincode::config::standard().with_limit::<MAX>();
    let (value, read) = bincode::serde::decode_from_slice(bytes, config)
        .map_err(|e| CodecError::Header(e.to_string()))?;
    match bytes.len() - read {
        0 => Ok(value),
        rest => Err(CodecError::Header(format!("{rest} bytes after its end"))),
    }
}

/// Encodes a value that is not a message, for files and hashes.
pub fn encode_value<T: Serialize>(value: &T) -> Result<Vec<u8>, CodecError> {
    encode_within(value, VALUE_BYTES_MAX)
}

/// Decodes what [`encode_value`] wrote. The caller must check that the bytes are undamaged.
pub fn decode_value<T: DeserializeOwned>(bytes: &[u8]) -> Result<T, CodecError> {
    decode_within::<T, VALUE_BYTES_MAX>(bytes)
}

/// Returns prefix and header of a message. On the wire, `payload` follows these bytes; it is not copied.
pub fn encode_head<M: Message>(
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
    let mut sum = prefix.start_checksum();
    sum.update(&header);
    sum.update(payload);
    prefix.checksum = sum.finalize();
    Ok([&prefix.to_bytes()[..], &header].concat())
}

/// Encodes a whole message into one buffer, for small messages and for tests.
pub fn encode<M: Message>(
    spec_hash: u64,
    message: &M,
    payload: &[u8],
) -> Result<Vec<u8>, CodecError> {
    Ok([&encode_head(spec_hash, message, payload)?, payload].concat())
}

/// Checks a message in one buffer and returns the message and its payload.
///
/// `spec_hash` is the hash of this process's run, or `None` to accept any run, for a process that joins to learn the hash.
pub fn decode<M: Message>(bytes: &[u8], spec_hash: Option<u64>) -> Result<(M, &[u8]), CodecError> {
    let (message, payload) = decode_from(bytes, bytes.len(), &BufferPool::new(0), spec_hash)?;
    Ok((message, &bytes[bytes.len() - payload.len()..]))
}

/// Checks a message of `len` bytes and copies its payload into private memory from `pool`.
///
/// The checksum covers the copy, so the checked bytes cannot change afterwards, even if they came through shared memory.
pub fn decode_from<M: Message>(
    mut bytes: impl Read,
    len: usize,
    pool: &BufferPool,
    spec_hash: Option<u64>,
) -> Result<(M, Buffer), CodecError> {
    let mut prefix = [0; PREFIX_BYTES];
    bytes
        .read_exact(&mut prefix)
        .map_err(|_| CodecError::Length {
            have: len,
            need: PREFIX_BYTES,
        })?;
    let prefix = Prefix::decode(&prefix, len)?;
    let mut sum = prefix.start_checksum();
    let mut header = vec![0; prefix.header_len()];
    copy_and_sum(&mut bytes, &mut header, &mut sum);
    let mut payload = pool.take_private(prefix.payload_len());
    copy_and_sum(&mut bytes, &mut payload, &mut sum);
    let message = prefix.decode_message(sum, &header, &payload, spec_hash)?;
    Ok((message, payload))
}

/// Copies the next bytes into `out` a block at a time, and adds each block to the checksum while it is in the cache.
/// If `bytes` ends early, the checksum will not match.
fn copy_and_sum(bytes: &mut impl Read, out: &mut [u8], sum: &mut crc32fast::Hasher) {
    for block in out.chunks_mut(BLOCK_BYTES) {
        if bytes.read_exact(block).is_err() {
            return;
        }
        sum.update(block);
    }
}

/// The first bytes of every message: fields of fixed width, in the order in which they are sent.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
struct Prefix {
    /// `DRML`, which tells messages of DRIML from foreign bytes.
    magic: u32,
    /// The protocol version; messages of other versions are rejected.
    version: u16,
    /// The kind of message: a [`Kind`](crate::Kind).
    kind: u16,
    /// The hash of the run's spec, so that runs do not mix.
    spec_hash: u64,
    header_bytes: u32,
    payload_bytes: u64,
    /// CRC-32 of the fields before it, the header and the payload. It must stay the last field.
    checksum: u32,
}

impl Prefix {
    const MAGIC: u32 = u32::from_le_bytes(*b"DRML");

    fn to_bytes(self) -> [u8; PREFIX_BYTES] {
        let mut bytes = [0; PREFIX_BYTES];
        let written = bincode::serde::encode_into_slice(self, &mut bytes, PREFIX_ENCODING);
        debug_assert_eq!(written.ok(), Some(PREFIX_BYTES));
        bytes
    }

    /// Starts a checksum with the fields before `checksum`; the caller adds header and payload.
    fn start_checksum(self) -> crc32fast::Hasher {
        let mut sum = crc32fast::Hasher::new();
        sum.update(&self.to_bytes()[..PREFIX_BYTES - size_of::<u32>()]);
        sum
    }

    /// Decodes the prefix of a message of `len` bytes in all, and checks its magic, version and lengths.
    fn decode(bytes: &[u8; PREFIX_BYTES], len: usize) -> Result<Self, CodecError> {
        let read = bincode::serde::decode_from_slice(bytes, PREFIX_ENCODING);
        let this: Self = read.expect("any 32 bytes are seven integers").0;
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

    /// Decodes the message, after checking checksum, kind and run, and validates header and payload by its type.
    fn decode_message<M: Message>(
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
