//! Saves a checkpoint: writes and flushes each file, flushes the folder, and then renames the folder.

use std::{
    collections::BTreeMap,
    fs,
    path::{Path, PathBuf},
};

use driml_model::{Parameters, StoredAs};

use super::{
    contents::{
        AVERAGE, COMPANION, FORMAT, KEY, LearnerState, ONLINE, OPTIMIZER, STATE, STATE_SUM,
        StateFile, TARGET, hex_of, sha256_of,
    },
    description,
    error::{CheckpointError, io_error},
    folder::{PREFIX, list, prune, put_in_place, remove_or_warn, sync, tidy, write_durably},
};
use crate::{agent::Agent, error::UpdateError};

/// The contents of a checkpoint in addition to the learner's state.
#[derive(Clone, Copy, Debug)]
pub struct Label<'a> {
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
/// The files are written and flushed to disk in a folder aside, which is then renamed: a crash at any moment leaves the older
/// checkpoints whole and at most a `.tmp` folder, which the next save removes.
///
/// # Errors
/// A state that is not finite, or a failing file system, such as a full disk. Older checkpoints are then kept, and nothing of the new
/// one is left.
pub fn save(
    folder: &Path,
    state: &LearnerState,
    label: Label<'_>,
    keep: usize,
) -> Result<PathBuf, CheckpointError> {
    if keep == 0 {
        return Err(CheckpointError::KeepNone);
    }
    fs::create_dir_all(folder).map_err(io_error("create", folder))?;
    tidy(folder)?;
    let name = format!("{PREFIX}{:012}", state.agent.updates());
    let (path, aside) = (folder.join(&name), folder.join(format!("{name}.tmp")));
    let saved = write(&aside, state, label).and_then(|()| put_in_place(&aside, &path));
    if let Err(error) = saved {
        // The unfinished checkpoint would keep a full disk full.
        remove_or_warn(&aside);
        return Err(error);
    }
    let all = list(folder)?;
    for (_, old) in &all[..all.len().saturating_sub(keep)] {
        prune(old);
    }
    Ok(path)
}

/// Creates the folder `aside` and writes a checkpoint's files into it.
fn write(aside: &Path, state: &LearnerState, label: Label<'_>) -> Result<(), CheckpointError> {
    let agent = &state.agent;
    let mut files = tensor_files(agent, label).map_err(CheckpointError::Unsound)?;
    files.extend(label.companion.map(|bytes| (COMPANION, bytes.to_vec())));
    fs::create_dir(aside).map_err(io_error("create", aside))?;
    let mut sha256 = BTreeMap::new();
    for (name, bytes) in files {
        write_durably(&aside.join(name), &bytes)?;
        sha256.insert(name.to_owned(), sha256_of(&bytes));
    }
    let file = StateFile {
        format: FORMAT,
        run_spec_hash: hex_of(label.run_spec_hash),
        updates: agent.updates(),
        adam_step: agent.adam.step_count(),
        weights_version: state.weights_version,
        progress: state.run_counts.clone(),
        rng: state.rng.clone(),
        affinity: state.affinity.clone(),
        sha256,
    };
    let text = serde_json::to_vec_pretty(&file).map_err(|why| CheckpointError::Io {
        what: "encode",
        path: aside.join(STATE),
        why: why.into(),
    })?;
    write_durably(&aside.join(STATE), &text)?;
    // In the format of `sha256sum --check`.
    write_durably(
        &aside.join(STATE_SUM),
        format!("{}  {STATE}\n", sha256_of(&text)).as_bytes(),
    )?;
    sync(aside)
}

/// Serialises the networks and the moments, all of which must be finite, into files with their names.
fn tensor_files(
    agent: &Agent,
    label: Label<'_>,
) -> Result<Vec<(&'static str, Vec<u8>)>, UpdateError> {
    let described = |parameters: &Parameters, description: &str| {
        parameters.to_described_safetensors(StoredAs::F32, description::KEY, description)
    };
    let moments = agent.adam.to_tensors()?;
    let moments = safetensors::serialize(&moments, None).map_err(candle_core::Error::from)?;
    let mut files = vec![
        (ONLINE, described(agent.online(), label.description)?),
        (TARGET, described(agent.target(), label.without_heads)?),
        (OPTIMIZER, moments),
    ];
    if let Some(key) = agent.key_encoder() {
        files.push((KEY, described(key, label.description)?));
    }
    if let Some(average) = agent.average() {
        files.push((AVERAGE, described(average, label.without_heads)?));
    }
    Ok(files)
}
