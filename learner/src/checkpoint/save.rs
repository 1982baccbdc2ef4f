//! Saves a checkpoint: makes its files from a learner's state.
//! `folder` writes them.

use std::path::{Path, PathBuf};

use driml_model::{Parameters, WeightDtype};

use super::{
    contents::{
        AVERAGE, COMPANION, FORMAT, KEY_ENCODER, LearnerState, ONLINE, OPTIMIZER, STATE,
        STATE_SHA256, StateFile, TARGET, format_hash, sha256_hex,
    },
    description,
    error::CheckpointError,
    folder::{PREFIX, list, prune, store},
};
use crate::{agent::Agent, error::UpdateError};

/// The contents of a checkpoint in addition to the learner's state.
#[derive(Clone, Copy, Debug)]
pub struct Extras<'a> {
    /// Hash of the run's specification.
    pub run_spec_hash: u64,
    /// The description of the online network, from [`describe`](super::describe), for the metadata.
    pub description: &'a str,
    /// The description of a network without the auxiliary loss's heads, for the target and the averaged network.
    pub without_heads: &'a str,
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
    if keep == 0 {
        return Err(CheckpointError::KeepNone);
    }
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
        run_spec_hash: format_hash(extras.run_spec_hash),
        updates: agent.updates(),
        adam_step: agent.adam.step_count(),
        weights_version: state.weights_version,
        progress: state.run_counts.clone(),
        rng: state.rng.clone(),
        affinity: state.affinity.clone(),
        sha256: sums
            .map(|(name, bytes)| (name.to_string(), sha256_hex(bytes)))
            .collect(),
    };
    let text = serde_json::to_vec_pretty(&file).map_err(|why| CheckpointError::Io {
        what: "encode",
        path: STATE.into(),
        why: why.into(),
    })?;
    // In the format of `sha256sum --check`.
    let sum = format!("{}  {STATE}\n", sha256_hex(&text));
    files.extend([(STATE, text), (STATE_SHA256, sum.into_bytes())]);
    Ok(files)
}

/// Serialises the networks and the moments, all of which must be finite, into files with their names.
fn tensor_files(
    agent: &Agent,
    extras: Extras<'_>,
) -> Result<Vec<(&'static str, Vec<u8>)>, UpdateError> {
    let described = |parameters: &Parameters, description: &str| {
        parameters.to_described_safetensors(
            WeightDtype::F32,
            description::METADATA_KEY,
            description,
        )
    };
    let moments = agent.adam.to_tensors()?;
    let moments = safetensors::serialize(&moments, None).map_err(candle_core::Error::from)?;
    let mut files = vec![
        (ONLINE, described(agent.online(), extras.description)?),
        (TARGET, described(agent.target(), extras.without_heads)?),
        (OPTIMIZER, moments),
    ];
    if let Some(key) = agent.key_encoder() {
        files.push((KEY_ENCODER, described(key, extras.description)?));
    }
    if let Some(average) = agent.average() {
        files.push((AVERAGE, described(average, extras.without_heads)?));
    }
    Ok(files)
}
