//! The files of one checkpoint, and what `state.json` holds.

use std::{collections::BTreeMap, path::Path};

use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

use super::error::{CheckpointError, damaged};
use crate::{
    affinity::AffinityEstimator,
    agent::Agent,
    run_counts::{COUNT_MAX, RunCounts},
};

pub(super) const FORMAT: u32 = 4;
pub(super) const ONLINE: &str = "online.safetensors";
pub(super) const TARGET: &str = "target.safetensors";
/// The key encoder; present only for an auxiliary loss that has one, as CURL does.
pub(super) const KEY_ENCODER: &str = "key.safetensors";
/// The averaged network; present only with `average_tau`.
pub const AVERAGE: &str = "average.safetensors";
pub(super) const OPTIMIZER: &str = "optimizer.safetensors";
/// The caller's companion, if any.
pub(super) const COMPANION: &str = "lockstep.bin";
pub(super) const STATE: &str = "state.json";
/// The SHA-256 of [`STATE`], which contains the SHA-256 of the other files.
pub(super) const STATE_SHA256: &str = "state.json.sha256";

/// Everything that a learner changes while it learns.
#[derive(Debug)]
pub struct LearnerState {
    /// Networks, optimiser, count of updates.
    pub agent: Agent,
    /// The affinity estimate, if the run has one.
    pub affinity: Option<AffinityEstimator>,
    /// The generator behind augmentation and affinity.
    pub rng: ChaCha8Rng,
    /// Newest version of the weights that was published.
    pub weights_version: u64,
    /// The run's other counts.
    pub run_counts: RunCounts,
}

/// The contents of `state.json`: all of a checkpoint that is not a tensor.
#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct StateFile {
    pub(super) format: u32,
    pub(super) run_spec_hash: String,
    pub(super) updates: u64,
    pub(super) adam_step: u64,
    pub(super) weights_version: u64,
    pub(super) progress: RunCounts,
    pub(super) rng: ChaCha8Rng,
    pub(super) affinity: Option<AffinityEstimator>,
    /// SHA-256 of the other files, by name.
    pub(super) sha256: BTreeMap<String, String>,
}

/// The fields that every version of `state.json` has.
#[derive(Deserialize)]
struct Version {
    format: u32,
}

/// Reads a `state.json` and drops it, for fuzzing.
pub fn check_state(text: &[u8]) -> Result<(), CheckpointError> {
    StateFile::read(Path::new(""), text).map(drop)
}

impl StateFile {
    /// Parses the text of `state.json` in `folder` and checks its values.
    pub(super) fn read(folder: &Path, text: &[u8]) -> Result<Self, CheckpointError> {
        // The format comes first, as another version has other fields.
        if let Ok(Version { format }) = serde_json::from_slice(text)
            && format != FORMAT
        {
            return Err(CheckpointError::OtherFormat {
                folder: folder.to_owned(),
                format,
                ours: FORMAT,
            });
        }
        let read = serde_json::from_slice(text).map_err(|e| e.to_string());
        let checked = read.and_then(|state: Self| state.check_valid().map(|()| state));
        checked.map_err(|why| damaged(folder, STATE, why))
    }

    /// Checks what the types do not: a file with the right checksum need not be one that a learner wrote.
    fn check_valid(&self) -> Result<(), String> {
        for (name, count) in [
            ("updates", self.updates),
            ("adam_step", self.adam_step),
            ("weights_version", self.weights_version),
        ] {
            if count > COUNT_MAX {
                return Err(format!("{name} is {count}, more than {COUNT_MAX}"));
            }
        }
        let counts = &self.progress;
        if !counts.is_plausible() {
            return Err(format!("{counts:?} are counts that no run reaches"));
        }
        let valid = self.affinity.as_ref().map(AffinityEstimator::check_valid);
        valid.transpose().map_err(|why| why.to_string())?;
        Ok(())
    }
}

pub(super) fn sha256_hex(bytes: &[u8]) -> String {
    format!("{:x}", Sha256::digest(bytes))
}

pub(super) fn format_hash(hash: u64) -> String {
    format!("{hash:016x}")
}
