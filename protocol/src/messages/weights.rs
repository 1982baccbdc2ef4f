//! Weights in transit: the learner sends each version whole to the replay server, from which actors fetch it in pieces.
//! The payload is a safetensors file, which `driml-model` reads.
//!
//! Pieces are needed because a message must be sent within seconds (see `session`): a slow link gets the weights later, not never.

use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

use crate::wire::{error::CodecError, message::check_no_payload};

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
            // The actor checks the hash once all pieces have arrived.
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
        let is_announced = self.sha256 == <[u8; 32]>::from(Sha256::digest(safetensors));
        let why = "the weights' SHA-256 is not the one announced";
        CodecError::check(is_announced, why)
    }
}
