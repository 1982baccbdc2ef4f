//! Weights in transit: the learner sends each version whole to the replay server, from which actors fetch it in pieces.
//! The payload is a safetensors file, which `driml-model` reads.
//!
//! Pieces are needed because a message must be sent within seconds (see `session`): a slow link gets the weights later, not never.

use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

use crate::wire::{codec::PAYLOAD_BYTES_MAX, error::CodecError, message::check_no_payload};

/// Bytes of weights in one message to an actor; the last piece has fewer.
pub const PIECE_BYTES: usize = 1 << 18;

/// Announces the newest weights at each new version: a small message.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct WeightsVersion {
    /// Counts up from 1.
    pub version: u64,
}

/// The description of one version of the weights.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct WeightsHeader {
    /// Counts up from 1.
    pub version: u64,
    /// Number of updates that led to these weights.
    pub updates: u64,
    /// SHA-256 of the safetensors file.
    pub sha256: [u8; 32],
}

/// One version of the learner's weights, whole.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Weights {
    /// The description of the weights.
    pub header: WeightsHeader,
    /// The networks' parameters, a safetensors file.
    pub safetensors: Vec<u8>,
}

/// New weights from the learner to the replay server; the payload is a safetensors file.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct WeightsUpload {
    /// The sender's number, as in its [`LearnerJoin`](crate::LearnerJoin).
    pub learner: u64,
    /// The description of the weights.
    pub weights: WeightsHeader,
}

impl WeightsUpload {
    pub(super) fn check_payload(&self, payload: &[u8]) -> Result<(), CodecError> {
        self.weights.check_hash(payload)
    }
}

/// An actor's request for weights.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum WeightsRequest {
    /// The first piece of the newest weights, if their version is above this one.
    NewerThan(u64),
    /// The piece of these weights that starts at `offset`.
    Piece {
        /// The version of the weights, from the header of the first piece.
        version: u64,
        /// Position of the piece in the safetensors file, bytes: a multiple of [`PIECE_BYTES`].
        offset: u64,
    },
}

/// The reply to a [`WeightsRequest`].
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum WeightsReply {
    /// There are no newer weights.
    NoneNewer,
    /// These weights are no longer kept, or have no such piece: ask for the newest.
    Gone,
    /// The payload that follows is a piece of these weights.
    Piece {
        /// The description of the whole weights.
        weights: WeightsHeader,
        /// Bytes of the whole safetensors file.
        bytes: u64,
        /// Position of the piece in the safetensors file, bytes.
        offset: u64,
    },
}

impl WeightsReply {
    pub(super) fn check_payload(&self, payload: &[u8]) -> Result<(), CodecError> {
        match self {
            // [`WeightsAssembly`] checks that the piece is the expected one.
            Self::Piece { .. } => Ok(()),
            Self::NoneNewer | Self::Gone => check_no_payload(payload),
        }
    }
}

impl WeightsHeader {
    /// Creates the description of `safetensors`.
    pub fn new(version: u64, updates: u64, safetensors: &[u8]) -> Self {
        Self {
            version,
            updates,
            sha256: Sha256::digest(safetensors).into(),
        }
    }

    /// The hash in hexadecimal.
    pub fn sha256_hex(&self) -> String {
        self.sha256.iter().map(|b| format!("{b:02x}")).collect()
    }

    /// Checks that `safetensors` has the hash of this description.
    pub fn check_hash(&self, safetensors: &[u8]) -> Result<(), CodecError> {
        if self.sha256 == <[u8; 32]>::from(Sha256::digest(safetensors)) {
            Ok(())
        } else {
            Err(CodecError::Header(
                "the weights' SHA-256 is not the one announced".into(),
            ))
        }
    }
}

/// Weights of which some pieces have arrived.
#[derive(Debug)]
pub struct WeightsAssembly {
    weights: WeightsHeader,
    bytes: usize,
    received: Vec<u8>,
}

impl WeightsAssembly {
    /// Starts to receive weights of `bytes` bytes in all.
    pub fn new(weights: WeightsHeader, bytes: u64) -> Result<Self, CodecError> {
        let bytes = usize::try_from(bytes).unwrap_or(usize::MAX);
        CodecError::check_size(bytes, PAYLOAD_BYTES_MAX)?;
        Ok(Self {
            weights,
            bytes,
            received: Vec::new(),
        })
    }

    /// Appends the next piece.
    ///
    /// # Errors
    /// The piece is of other weights or is not the next one. It is then dropped.
    pub fn push(
        &mut self,
        weights: WeightsHeader,
        offset: u64,
        piece: &[u8],
    ) -> Result<(), CodecError> {
        let left = self.bytes - self.received.len();
        if weights != self.weights
            || offset != self.next_offset()
            || piece.len() != left.min(PIECE_BYTES)
        {
            return Err(CodecError::Header(format!(
                "received {} bytes at {offset} of weights {}, expected {} at {} of weights {}",
                piece.len(),
                weights.version,
                left.min(PIECE_BYTES),
                self.next_offset(),
                self.weights.version
            )));
        }
        self.received.extend_from_slice(piece);
        Ok(())
    }

    /// Position at which the next piece starts, bytes.
    pub const fn next_offset(&self) -> u64 {
        self.received.len() as u64
    }

    /// Bytes of the whole safetensors file.
    pub const fn bytes(&self) -> u64 {
        self.bytes as u64
    }

    /// Whether all pieces have arrived.
    pub const fn is_complete(&self) -> bool {
        self.received.len() == self.bytes
    }

    /// Returns the whole weights, after checking their hash.
    pub fn finish(self) -> Result<Weights, CodecError> {
        self.weights.check_hash(&self.received)?;
        Ok(Weights {
            header: self.weights,
            safetensors: self.received,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pieces_make_the_whole_in_their_order_alone() {
        let file: Vec<u8> = (0..PIECE_BYTES + 10).map(|i| (i % 251) as u8).collect();
        let weights = WeightsHeader::new(3, 7, &file);
        let mut assembly = WeightsAssembly::new(weights, file.len() as u64).unwrap();
        let (first, second) = file.split_at(PIECE_BYTES);
        let at = PIECE_BYTES as u64;
        assert!(assembly.push(weights, at, first).is_err(), "not its turn");
        assert!(assembly.push(weights, 0, &first[1..]).is_err(), "too short");
        let other = WeightsHeader {
            version: 4,
            ..weights
        };
        assert!(assembly.push(other, 0, first).is_err(), "of other weights");
        assembly.push(weights, 0, first).unwrap();
        assert!(!assembly.is_complete());
        assembly.push(weights, at, second).unwrap();
        assert!(assembly.is_complete());
        let whole = Weights {
            header: weights,
            safetensors: file.clone(),
        };
        assert_eq!(assembly.finish().unwrap(), whole);

        let mut damaged = WeightsAssembly::new(weights, 10).unwrap();
        damaged.push(weights, 0, second).unwrap();
        assert!(damaged.finish().is_err(), "another SHA-256");
        assert!(WeightsAssembly::new(weights, u64::MAX).is_err());
    }
}
