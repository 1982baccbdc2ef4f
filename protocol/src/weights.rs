//! Weights on their way from the learner to the actors.
//! It does not read them: the planes are a safetensors file, which `driml-model` knows.

use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

use crate::codec::{self, CodecError, Kind};

/// "These are the newest weights": small, sent at each new version.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct WeightsVersion {
    /// Counts up from 1.
    pub version: u64,
}

/// What a weights message says of itself; its planes are a safetensors file.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct WeightsHeader {
    /// Counts up from 1.
    pub version: u64,
    /// Updates behind these weights.
    pub updates: u64,
    /// SHA-256 of the planes.
    pub sha256: [u8; 32],
}

impl WeightsHeader {
    /// Describes `safetensors`.
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

    /// Reads a weights message and checks the hash of its planes.
    ///
    /// # Errors
    /// A damaged or foreign message, or planes that are not what the header describes.
    pub fn decode(bytes: &[u8], spec_hash: u64) -> Result<(Self, &[u8]), CodecError> {
        let (header, planes): (Self, _) = codec::decode(bytes, Kind::Weights, Some(spec_hash))?;
        if header.sha256 != <[u8; 32]>::from(Sha256::digest(planes)) {
            return Err(CodecError::Header(
                "the weights' SHA-256 is not the one announced".into(),
            ));
        }
        Ok((header, planes))
    }
}
