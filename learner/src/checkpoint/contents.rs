//! The files of one checkpoint, which are made from a learner's state.
//! `folder` writes them, and `load` reads them.

use std::{
    collections::BTreeMap,
    path::{Path, PathBuf},
};

use driml_model::{InputSize, ModelConfig, Parameters, WeightDtype};
use driml_protocol::RunSpec;
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

use super::{
    description::{METADATA_KEY, describe},
    error::{CheckpointError, damaged, io_error},
    folder::{PREFIX, list, prune, store},
};
use crate::{
    affinity::AffinityEstimator,
    agent::Agent,
    error::Result,
    run_counts::{COUNT_MAX, RunCounts},
};

const FORMAT: u32 = 4;
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
    format: u32,
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
            return Err(CheckpointError::Mismatch(format!(
                "the checkpoint {} was written by another version of this program (format {format}, this one reads {FORMAT}): use that version",
                folder.display()
            )));
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

/// The contents of a checkpoint in addition to the learner's state.
#[derive(Clone, Copy, Debug)]
pub struct Extras<'a> {
    /// The run's specification.
    pub spec: &'a RunSpec,
    /// The size at which the network sees a frame.
    pub input: &'a InputSize,
    /// Bytes that the caller keeps with the checkpoint.
    pub companion: Option<&'a [u8]>,
}

/// Writes `folder/checkpoint-<updates>` and removes all but the newest `keep` checkpoints.
///
/// # Errors
/// A state that is not finite, or a failing file system, such as a full disk. Older checkpoints are then kept, and nothing of the new
/// one is left.
pub fn save(
    folder: &Path,
    state: &LearnerState,
    extras: Extras<'_>,
    keep: usize,
) -> Result<PathBuf, CheckpointError> {
    assert!(keep > 0, "`Config::validate` demands one checkpoint");
    let name = format!("{PREFIX}{:012}", state.agent.updates());
    let path = store(folder, &name, &files(state, extras)?)?;
    let all = list(folder)?;
    for (_, old) in &all[..all.len().saturating_sub(keep)] {
        prune(old);
    }
    Ok(path)
}

/// A checkpoint's files, with their names.
fn files(
    state: &LearnerState,
    extras: Extras<'_>,
) -> Result<Vec<(&'static str, Vec<u8>)>, CheckpointError> {
    let agent = &state.agent;
    let mut files = tensor_files(agent, extras).map_err(CheckpointError::Unsound)?;
    files.extend(extras.companion.map(|bytes| (COMPANION, bytes.to_vec())));
    let sums = files.iter();
    let file = StateFile {
        format: FORMAT,
        run_spec_hash: format_hash(extras.spec.hash()),
        updates: agent.updates(),
        adam_step: agent.adam.step,
        weights_version: state.weights_version,
        progress: state.run_counts.clone(),
        rng: state.rng.clone(),
        affinity: state.affinity.clone(),
        sha256: sums
            .map(|(name, bytes)| (name.to_string(), sha256_hex(bytes)))
            .collect(),
    };
    let text = serde_json::to_vec_pretty(&file);
    let text = text.map_err(|why| io_error("encode", Path::new(STATE))(why.into()))?;
    // In the format of `sha256sum --check`.
    let sum = format!("{}  {STATE}\n", sha256_hex(&text));
    files.extend([(STATE, text), (STATE_SHA256, sum.into_bytes())]);
    Ok(files)
}

/// Serialises the networks and the moments, all of which must be finite, into files with their names.
fn tensor_files(agent: &Agent, extras: Extras<'_>) -> Result<Vec<(&'static str, Vec<u8>)>> {
    let described = |parameters: &Parameters, model: &ModelConfig| {
        let description = describe(extras.spec, model, extras.input);
        parameters.to_described_safetensors(WeightDtype::F32, METADATA_KEY, &description)
    };
    let (model, without_heads) = (agent.model(), agent.model().without_dim());
    let moments = agent.adam.to_tensors()?;
    let moments = safetensors::serialize(&moments, None).map_err(candle_core::Error::from)?;
    let mut files = vec![
        (ONLINE, described(agent.online(), model)?),
        (TARGET, described(agent.target(), &without_heads)?),
        (OPTIMIZER, moments),
    ];
    if let Some(key) = agent.key_encoder() {
        files.push((KEY_ENCODER, described(key, model)?));
    }
    if let Some(average) = agent.average() {
        files.push((AVERAGE, described(average, &without_heads)?));
    }
    Ok(files)
}
