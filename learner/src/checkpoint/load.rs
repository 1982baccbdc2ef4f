//! Loads a checkpoint, completely or not at all.

use std::path::Path;

use candle_core::Device;
use driml_model::{Compute, Encoder, ModelConfig, Parameters};
use driml_protocol::config::first_difference;
use serde_json::Value;

use super::{
    contents::{
        AVERAGE, COMPANION, KEY_ENCODER, LearnerState, ONLINE, OPTIMIZER, STATE, STATE_SHA256,
        StateFile, TARGET, format_hash, sha256_hex,
    },
    description,
    error::{CheckpointError, damaged},
    folder::{list, read_file},
};
use crate::{
    affinity::AffinityEstimator,
    agent::{Agent, NetworkParameters},
    run_counts::RunCounts,
    settings::UpdateSettings,
};

/// Loads the newest checkpoint in `folder` onto the device of `compute`; `None` if there are none. A damaged one is an error, not skipped.
pub fn load_latest(
    folder: &Path,
    model: &ModelConfig,
    settings: &UpdateSettings,
    compute: &Compute,
    run_spec_hash: u64,
) -> Result<Option<LearnerState>, CheckpointError> {
    match list(folder)?.last() {
        Some((_, path)) => load(path, model, settings, compute, run_spec_hash).map(Some),
        None => Ok(None),
    }
}

/// Loads one checkpoint onto the device of `compute`, whichever device it was saved from.
///
/// # Errors
/// A missing or damaged file, a run of another specification, or a network of other sizes.
pub fn load(
    path: &Path,
    model: &ModelConfig,
    settings: &UpdateSettings,
    compute: &Compute,
    run_spec_hash: u64,
) -> Result<LearnerState, CheckpointError> {
    let state = read_state(path)?;
    let expected = format_hash(run_spec_hash);
    if state.run_spec_hash != expected {
        return Err(CheckpointError::Mismatch(format!(
            "{} belongs to a run with specification {}, this run's is {expected}: resume with the settings it was made with, or choose \
             another folder",
            path.display(),
            state.run_spec_hash
        )));
    }
    let has_key = settings.make_auxiliary_loss()?.key_tau().is_some();
    let tensors = |name: &str| read_verified(path, &state, name);
    let online = tensors(ONLINE)?;
    check_model(path, &online, model)?;
    let parameters = |model: &ModelConfig, part: fn(&str) -> bool, name: &str, bytes: &[u8]| {
        let loaded = Parameters::load_safetensors(model, part, bytes, &compute.device);
        loaded.map_err(|why| damaged(path, name, why.to_string()))
    };
    let in_key = Encoder::has_parameter;
    let key = has_key.then(|| parameters(model, in_key, KEY_ENCODER, &tensors(KEY_ENCODER)?));
    let has_average = state.sha256.contains_key(AVERAGE);
    let average = (settings.average_tau.is_some() && has_average)
        .then(|| parameters(&model.without_dim(), |_| true, AVERAGE, &tensors(AVERAGE)?));
    let networks = NetworkParameters {
        online: parameters(model, |_| true, ONLINE, &online)?,
        target: parameters(&model.without_dim(), |_| true, TARGET, &tensors(TARGET)?)?,
        key_encoder: key.transpose()?,
    };
    let average = average.transpose()?;
    let moments = candle_core::safetensors::load_buffer(&tensors(OPTIMIZER)?, &Device::Cpu)
        .map_err(|why| damaged(path, OPTIMIZER, why.to_string()))?;
    let (model, settings) = (model.clone(), settings.clone());
    let mut agent = Agent::from_parameters(model, settings, compute, networks)?;
    let restored = agent.adam.restore(state.adam_step, moments);
    restored.map_err(|why| damaged(path, OPTIMIZER, why.to_string()))?;
    agent.updates = state.updates;
    // Without a saved average, a run that has `average_tau` starts averaging with its next update.
    agent.average = average;
    Ok(LearnerState {
        agent,
        affinity: state.affinity,
        rng: state.rng,
        weights_version: state.weights_version,
        run_counts: state.progress,
    })
}

/// Checks that the network `online` of the checkpoint at `path` has the sizes of `model`, if the checkpoint describes them.
fn check_model(path: &Path, online: &[u8], model: &ModelConfig) -> Result<(), CheckpointError> {
    let described = description::read_description(online).ok().flatten();
    let Some(saved) = described.as_ref().and_then(|it| it.get("model")) else {
        return Ok(());
    };
    // Through text, as for the saved description: converted directly, a 32-bit number would have more digits.
    let ours = serde_json::to_string(model).and_then(|text| serde_json::from_str(&text));
    let ours: Value = ours.unwrap_or_default();
    // If the torso differs, only that is reported: other differences follow from it.
    let torso = first_difference("model.torso", &saved["torso"], &ours["torso"]);
    match torso.or_else(|| first_difference("model", saved, &ours)) {
        None => Ok(()),
        Some((key, found, expected)) => Err(CheckpointError::Mismatch(format!(
            "the checkpoint {} was saved with {key} = {found}, this run has {key} = {expected}: resume with the settings it was made with, or choose \
             another folder",
            path.display()
        ))),
    }
}

/// Reads the number of updates and the run's other counts from the checkpoint at `path`, without its tensors.
pub fn read_run_counts(path: &Path) -> Result<(u64, RunCounts), CheckpointError> {
    let state = read_state(path)?;
    Ok((state.updates, state.progress))
}

/// Reads the affinity estimate from the checkpoint at `path`; `None` if the run has none.
pub fn read_affinity(path: &Path) -> Result<Option<AffinityEstimator>, CheckpointError> {
    Ok(read_state(path)?.affinity)
}

/// Reads the caller's companion from the checkpoint at `path`, if any.
pub fn read_companion(path: &Path) -> Result<Option<Vec<u8>>, CheckpointError> {
    let state = read_state(path)?;
    let has_companion = state.sha256.contains_key(COMPANION);
    let companion = has_companion.then(|| read_verified(path, &state, COMPANION));
    companion.transpose()
}

fn read_state(path: &Path) -> Result<StateFile, CheckpointError> {
    let text = read_file(path, STATE)?;
    let sum = read_file(path, STATE_SHA256)?;
    if !sum.starts_with(sha256_hex(&text).as_bytes()) {
        let why = format!("its SHA-256 is not the one in {STATE_SHA256}");
        return Err(damaged(path, STATE, why));
    }
    StateFile::read(path, &text)
}

/// Reads the checkpoint's file `name` and checks its SHA-256.
fn read_verified(path: &Path, state: &StateFile, name: &str) -> Result<Vec<u8>, CheckpointError> {
    let bytes = read_file(path, name)?;
    if state.sha256.get(name) == Some(&sha256_hex(&bytes)) {
        return Ok(bytes);
    }
    let length = bytes.len();
    let why = format!("the SHA-256 of its {length} bytes is not the one in {STATE}");
    Err(damaged(path, name, why))
}
