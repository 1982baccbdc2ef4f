//! The first bytes of every message, as a type: each field with its width, in the order in which they travel.
//! What follows them, and what makes it good, is the codec's business.

use bincode::config::{Configuration, Fixint, LittleEndian};
use serde::{Deserialize, Serialize};

/// Integers of fixed width, without gaps.
const FIXED: Configuration<LittleEndian, Fixint> =
    bincode::config::standard().with_fixed_int_encoding();

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct Prefix {
    /// `DRML`, so that strangers are told from us.
    pub(super) magic: u32,
    /// The protocol's version; others are refused.
    pub(super) version: u16,
    /// Which message it is: a [`Kind`](crate::Kind).
    pub(super) kind: u16,
    /// The hash of the run's spec, so that runs are not mixed.
    pub(super) spec_hash: u64,
    pub(super) header_bytes: u32,
    pub(super) payload_bytes: u64,
    /// CRC-32 of the prefix before it, the header and the payload. It stays the last field.
    pub(super) checksum: u32,
}

impl Prefix {
    pub(super) const MAGIC: u32 = u32::from_le_bytes(*b"DRML");
    /// Its length: the widths of all fields.
    pub(super) const BYTES: usize = 32;

    pub(super) fn to_bytes(self) -> [u8; Self::BYTES] {
        let mut bytes = [0; Self::BYTES];
        let written = bincode::serde::encode_into_slice(self, &mut bytes, FIXED);
        debug_assert_eq!(written.ok(), Some(Self::BYTES));
        bytes
    }

    /// The fields of bytes that came, whatever they say.
    pub(super) fn from_bytes(bytes: &[u8; Self::BYTES]) -> Self {
        let read = bincode::serde::decode_from_slice(bytes, FIXED);
        read.expect("any 32 bytes are seven integers").0
    }

    /// A checksum over the fields before it, to which header and payload are to be added.
    pub(super) fn checksum_begun(self) -> crc32fast::Hasher {
        let mut sum = crc32fast::Hasher::new();
        sum.update(&self.to_bytes()[..Self::BYTES - size_of::<u32>()]);
        sum
    }
}
