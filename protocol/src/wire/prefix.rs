//! The first bytes of every message, as a type: each field with its width, in the order in which they travel.
//! What follows them, and what makes it good, is the codec's business.

/// Defines the prefix, and its bytes as they follow from the fields: little-endian, one after the other, without gaps.
macro_rules! prefix {
    ($($(#[$doc:meta])* $field:ident: $type:ty,)*) => {
        #[derive(Clone, Copy, Debug, PartialEq, Eq)]
        pub(super) struct Prefix {
            $($(#[$doc])* pub(super) $field: $type,)*
        }

        impl Prefix {
            /// Its length: the widths of all fields.
            pub(super) const BYTES: usize = 0 $(+ size_of::<$type>())*;

            pub(super) fn to_bytes(self) -> [u8; Self::BYTES] {
                let mut bytes = [0; Self::BYTES];
                let mut at = 0;
                $(
                    bytes[at..at + size_of::<$type>()].copy_from_slice(&self.$field.to_le_bytes());
                    at += size_of::<$type>();
                )*
                debug_assert_eq!(at, Self::BYTES);
                bytes
            }

            /// The fields of bytes that came, whatever they say.
            pub(super) fn from_bytes(bytes: &[u8; Self::BYTES]) -> Self {
                let mut at = 0;
                $(
                    let mut field = [0; size_of::<$type>()];
                    field.copy_from_slice(&bytes[at..at + size_of::<$type>()]);
                    let $field = <$type>::from_le_bytes(field);
                    at += size_of::<$type>();
                )*
                debug_assert_eq!(at, Self::BYTES);
                Self { $($field,)* }
            }
        }
    };
}

prefix! {
    /// `DRML`, so that strangers are told from us.
    magic: u32,
    /// The protocol's version; others are refused.
    version: u16,
    /// Which message it is: a [`Kind`](crate::Kind).
    kind: u16,
    /// The hash of the run's spec, so that runs are not mixed.
    spec_hash: u64,
    /// Length of the header, which follows the prefix.
    header_bytes: u32,
    /// Length of the payload, which follows the header.
    payload_bytes: u64,
    /// CRC-32 of the prefix before it, the header and the payload. It stays the last field.
    checksum: u32,
}

const _: () = assert!(Prefix::BYTES == 32);

impl Prefix {
    pub(super) const MAGIC: u32 = u32::from_le_bytes(*b"DRML");

    /// A checksum over the fields before it, to which header and payload are to be added.
    pub(super) fn checksum_begun(self) -> crc32fast::Hasher {
        let mut sum = crc32fast::Hasher::new();
        sum.update(&self.to_bytes()[..Self::BYTES - size_of::<u32>()]);
        sum
    }
}
