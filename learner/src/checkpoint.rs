//! Checkpoints: all of a learner's state in one folder, from which a run resumes bit for bit.
//! It does not decide when to save, and never falls back to an older checkpoint by itself.

use std::{
    collections::BTreeMap,
    fs::{self, File},
    io::{self, Write},
    path::{Path, PathBuf},
};

use candle_core::Device;
use driml_model::{Compute, Encoder, ModelConfig, Parameters};
use driml_protocol::lock_file;
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

use crate::{
    affinity::AffinityEstimator,
    agent::{Agent, NetworkParameters},
    error::UpdateError,
    settings::LearnerSettings,
};

/// The folder in a run's folder in which its checkpoints lie.
pub const FOLDER: &str = "checkpoints";
/// 2: CURL's key encoder has a file of its own. All else is as in 1.
const FORMAT: u32 = 2;
const PREFIX: &str = "checkpoint-";
const ONLINE: &str = "online.safetensors";
const TARGET: &str = "target.safetensors";
/// CURL's key encoder; there for that objective alone.
const KEY: &str = "key.safetensors";
const OPTIMIZER: &str = "optimizer.safetensors";
const STATE: &str = "state.json";
const LOCK: &str = ".lock";
const STATE_SUM: &str = "state.json.sha256";
/// Largest count in a state: no run comes near it, and what is added to counts cannot overflow.
const COUNT_MAX: u64 = 1 << 53;
/// What follows the name of a checkpoint while one of the same update takes its place.
const REPLACED: &str = ".replaced.tmp";

/// Why a checkpoint was not written or not read.
#[derive(Debug, thiserror::Error)]
pub enum CheckpointError {
    /// The file system refused.
    #[error("cannot {what} {path}: {why}")]
    Io {
        /// What was being done.
        what: &'static str,
        /// The file or folder to which it was being done.
        path: PathBuf,
        /// What the file system said.
        why: io::Error,
    },
    /// A file is not what was written.
    #[error(
        "{file} is damaged: {why}. To resume from the checkpoint before it, remove the folder it is in; \
         to begin anew, remove all checkpoint-* folders beside it"
    )]
    Damaged {
        /// The damaged file.
        file: PathBuf,
        /// What is wrong with it.
        why: String,
    },
    /// The checkpoint is another run's.
    #[error(
        "{folder} belongs to a run with specification {found}, this run's is {expected}: \
         resume with the settings it was made with, or choose another folder"
    )]
    OtherRun {
        /// The folder of the checkpoint.
        folder: PathBuf,
        /// Hash of the run that wrote it.
        found: String,
        /// Hash of this run.
        expected: String,
    },
    /// The checkpoint was written before its agent was what it is now.
    #[error(
        "{} was saved by an earlier version, in which CURL's keys came from the target network; now a moving average of its \
         own encodes them, which this checkpoint lacks: go on with the earlier version, or begin anew in another folder", .0.display()
    )]
    WithoutKeyEncoder(PathBuf),
    /// The learner's state is not one to go on from.
    #[error("nothing is saved, and the newest checkpoint stays the newest: {0}")]
    Unsound(UpdateError),
    /// The state does not fit the network or the settings.
    #[error("checkpoint: {0}")]
    Update(#[from] UpdateError),
    /// Another learner saves in the folder.
    #[error("another learner saves in {}: wait until it has ended, or choose another folder", .0.display())]
    InUse(PathBuf),
    /// The number of checkpoints to keep is 0.
    #[error("at least one checkpoint must be kept")]
    KeepNone,
}

/// What a checkpoint holds, borrowed for saving.
#[derive(Clone, Copy, Debug)]
pub struct RunState<'a> {
    /// Networks, optimiser, count of updates.
    pub agent: &'a Agent,
    /// The affinity estimate, if the run has one.
    pub affinity: Option<&'a AffinityEstimator>,
    /// The generator behind augmentation and affinity.
    pub rng: &'a ChaCha8Rng,
    /// Newest version of the weights that was published.
    pub weights_version: u64,
    /// Hash of the run's specification.
    pub run_spec_hash: u64,
}

/// What a checkpoint gave.
#[derive(Debug)]
pub struct Restored {
    /// Networks, optimiser, count of updates.
    pub agent: Agent,
    /// The affinity estimate, if the run had one.
    pub affinity: Option<AffinityEstimator>,
    /// The generator behind augmentation and affinity.
    pub rng: ChaCha8Rng,
    /// Newest version of the weights that had been published.
    pub weights_version: u64,
}

/// The contents of `state.json`: all of a checkpoint that is not a tensor.
#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct StateFile {
    format: u32,
    run_spec_hash: String,
    updates: u64,
    adam_step: u64,
    weights_version: u64,
    rng: ChaCha8Rng,
    affinity: Option<AffinityEstimator>,
    /// SHA-256 of the tensor files, by name.
    sha256: BTreeMap<String, String>,
}

impl StateFile {
    /// Checks what its types do not hold: a file may be right by its sum and still not be one that a learner wrote.
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
        let valid = self.affinity.as_ref().map(AffinityEstimator::check_valid);
        valid.transpose().map_err(|why| why.to_string())?;
        Ok(())
    }
}

/// Writes `folder/checkpoint-<updates>` and removes all but the newest `keep` checkpoints.
///
/// Every file is written aside, flushed to disk and renamed; so is the folder: a crash at any moment leaves the older
/// checkpoints whole and at most a `.tmp` folder, which the next save removes.
///
/// # Errors
/// A state that is not finite, or a failing file system, such as a full disk; nothing older has then been removed, and nothing
/// of the new one is left.
pub fn save(folder: &Path, state: &RunState<'_>, keep: usize) -> Result<PathBuf, CheckpointError> {
    if keep == 0 {
        return Err(CheckpointError::KeepNone);
    }
    fs::create_dir_all(folder).map_err(io_error("create", folder))?;
    tidy(folder)?;
    let name = format!("{PREFIX}{:012}", state.agent.updates());
    let (path, aside) = (folder.join(&name), folder.join(format!("{name}.tmp")));
    let saved = write(&aside, state).and_then(|()| put_in_place(&aside, &path));
    if let Err(error) = saved {
        // It would keep a full disk full.
        if let Err(e) = remove_if_there(&aside) {
            tracing::warn!("a checkpoint was not saved, and a part of it stays: {e}");
        }
        return Err(error);
    }
    let all = list(folder)?;
    for (_, old) in &all[..all.len().saturating_sub(keep)] {
        fs::remove_dir_all(old).map_err(io_error("remove", old))?;
    }
    Ok(path)
}

/// Writes a checkpoint's files into the folder `aside`, which is made.
fn write(aside: &Path, state: &RunState<'_>) -> Result<(), CheckpointError> {
    let agent = state.agent;
    let files = tensor_files(agent).map_err(CheckpointError::Unsound)?;
    fs::create_dir(aside).map_err(io_error("create", aside))?;
    let mut sha256 = BTreeMap::new();
    for (name, bytes) in files {
        write_durably(&aside.join(name), &bytes)?;
        sha256.insert(name.to_owned(), sha256_of(&bytes));
    }
    let file = StateFile {
        format: FORMAT,
        run_spec_hash: hex_of(state.run_spec_hash),
        updates: agent.updates(),
        adam_step: agent.adam.step_count(),
        weights_version: state.weights_version,
        rng: state.rng.clone(),
        affinity: state.affinity.cloned(),
        sha256,
    };
    let text = serde_json::to_vec_pretty(&file).map_err(|why| CheckpointError::Io {
        what: "encode",
        path: aside.join(STATE),
        why: why.into(),
    })?;
    write_durably(&aside.join(STATE), &text)?;
    // As `sha256sum --check` reads it.
    write_durably(
        &aside.join(STATE_SUM),
        format!("{}  {STATE}\n", sha256_of(&text)).as_bytes(),
    )?;
    sync(aside)
}

/// Gives a whole checkpoint its name. One of the same update, as at a stop right after a periodic save, gives way to it: between
/// the two renames it is known by its other name.
fn put_in_place(aside: &Path, path: &Path) -> Result<(), CheckpointError> {
    let folder = path.parent().unwrap_or(Path::new("."));
    let mut older = path.as_os_str().to_owned();
    older.push(REPLACED);
    let older = PathBuf::from(older);
    if path.exists() {
        fs::rename(path, &older).map_err(io_error("move", path))?;
    }
    fs::rename(aside, path).map_err(io_error("move", aside))?;
    sync(folder)?;
    remove_if_there(&older)
}

/// Removes what saves that were cut off have left, and gives a checkpoint that was to be replaced its name back.
fn tidy(folder: &Path) -> Result<(), CheckpointError> {
    for entry in fs::read_dir(folder).map_err(io_error("read", folder))? {
        let path = entry.map_err(io_error("read", folder))?.path();
        let name = path.file_name().and_then(|name| name.to_str());
        let Some(name) = name.filter(|it| it.starts_with(PREFIX) && it.ends_with(".tmp")) else {
            continue;
        };
        match name.strip_suffix(REPLACED).map(|name| folder.join(name)) {
            Some(place) if !place.exists() => {
                fs::rename(&path, place).map_err(io_error("move", &path))?;
            }
            _ => remove_if_there(&path)?,
        }
    }
    Ok(())
}

/// The files of tensors and their names, all finite.
fn tensor_files(agent: &Agent) -> Result<Vec<(&'static str, Vec<u8>)>, UpdateError> {
    let everything = |parameters: &Parameters| parameters.to_safetensors(|_| true);
    let moments = agent.adam.to_tensors()?;
    let moments = safetensors::serialize(&moments, None).map_err(candle_core::Error::from)?;
    let mut files = vec![
        (ONLINE, everything(agent.online())?),
        (TARGET, everything(agent.target())?),
        (OPTIMIZER, moments),
    ];
    if let Some(key) = agent.key() {
        files.push((KEY, everything(key)?));
    }
    Ok(files)
}

/// Keeps other learners from saving in `folder`, which is made, as long as the file is held.
///
/// # Errors
/// Another learner saves there, or the file system refuses.
pub fn lock(folder: &Path) -> Result<File, CheckpointError> {
    fs::create_dir_all(folder).map_err(io_error("create", folder))?;
    let path = folder.join(LOCK);
    let lock = lock_file::create(&path, "let no other learner save there");
    let lock = lock.map_err(io_error("create", &path))?;
    lock.ok_or_else(|| CheckpointError::InUse(folder.to_owned()))
}

/// The checkpoints in `folder`, oldest first, as (updates, path). A folder that does not exist has none.
///
/// # Errors
/// A folder that cannot be read.
pub fn list(folder: &Path) -> Result<Vec<(u64, PathBuf)>, CheckpointError> {
    let entries = match fs::read_dir(folder) {
        Ok(entries) => entries,
        Err(why) if why.kind() == io::ErrorKind::NotFound => return Ok(Vec::new()),
        Err(why) => return Err(io_error("read", folder)(why)),
    };
    let mut all = Vec::new();
    for entry in entries {
        let path = entry.map_err(io_error("read", folder))?.path();
        let name = path
            .file_name()
            .and_then(|name| name.to_str())
            .unwrap_or_default();
        let Some(rest) = name.strip_prefix(PREFIX) else {
            continue;
        };
        // One that is being replaced counts as long as the new one does not have its name.
        let replaced = rest.strip_suffix(REPLACED).map(|rest| {
            let is_replaced = folder.join(format!("{PREFIX}{rest}")).exists();
            (rest, is_replaced)
        });
        let (number, is_replaced) = replaced.unwrap_or((rest, false));
        match number.parse::<u64>() {
            Ok(updates) if !is_replaced => all.push((updates, path)),
            _ => {
                tracing::warn!(path = %path.display(), "left from an unfinished save; not a checkpoint")
            }
        }
    }
    all.sort();
    Ok(all)
}

/// Loads the newest checkpoint in `folder` onto the device of `compute`; `None` if there is none. A damaged one is an error, not skipped.
///
/// # Errors
/// As [`load`].
pub fn load_latest(
    folder: &Path,
    model: &ModelConfig,
    settings: &LearnerSettings,
    compute: &Compute,
    run_spec_hash: u64,
) -> Result<Option<Restored>, CheckpointError> {
    match list(folder)?.last() {
        Some((_, path)) => load(path, model, settings, compute, run_spec_hash).map(Some),
        None => Ok(None),
    }
}

/// Loads one checkpoint onto the device of `compute`, whichever it was saved from.
///
/// # Errors
/// A file that is missing or is not what was written, a run of another specification, a network of other sizes.
pub fn load(
    path: &Path,
    model: &ModelConfig,
    settings: &LearnerSettings,
    compute: &Compute,
    run_spec_hash: u64,
) -> Result<Restored, CheckpointError> {
    let text = read(&path.join(STATE))?;
    let sum = read(&path.join(STATE_SUM))?;
    if !sum.starts_with(sha256_of(&text).as_bytes()) {
        return Err(damaged(
            path,
            STATE,
            format!("its SHA-256 is not the one in {STATE_SUM}"),
        ));
    }
    let state: StateFile =
        serde_json::from_slice(&text).map_err(|why| damaged(path, STATE, why.to_string()))?;
    if !(1..=FORMAT).contains(&state.format) {
        return Err(damaged(
            path,
            STATE,
            format!("its format is {}, not 1 to {FORMAT}", state.format),
        ));
    }
    let expected = hex_of(run_spec_hash);
    if state.run_spec_hash != expected {
        let (folder, found) = (path.to_owned(), state.run_spec_hash);
        return Err(CheckpointError::OtherRun {
            folder,
            found,
            expected,
        });
    }
    let has_key = settings.auxiliary()?.key_tau().is_some();
    if state.format == 1 && has_key {
        return Err(CheckpointError::WithoutKeyEncoder(path.to_owned()));
    }
    state
        .check_valid()
        .map_err(|why| damaged(path, STATE, why))?;
    let tensors = |name: &str| {
        let bytes = read(&path.join(name))?;
        if state.sha256.get(name) == Some(&sha256_of(&bytes)) {
            Ok(bytes)
        } else {
            let length = bytes.len();
            Err(damaged(
                path,
                name,
                format!("the SHA-256 of its {length} bytes is not the one in {STATE}"),
            ))
        }
    };
    let parameters = |model: &ModelConfig, part: fn(&str) -> bool, name: &str| {
        let loaded = Parameters::load_part(model, part, &tensors(name)?, &compute.device);
        loaded.map_err(|why| damaged(path, name, why.to_string()))
    };
    let key = has_key.then(|| parameters(model, Encoder::has, KEY));
    let networks = NetworkParameters {
        online: parameters(model, |_| true, ONLINE)?,
        target: parameters(&model.without_dim(), |_| true, TARGET)?,
        key: key.transpose()?,
    };
    let moments = candle_core::safetensors::load_buffer(&tensors(OPTIMIZER)?, &Device::Cpu)
        .map_err(|why| damaged(path, OPTIMIZER, why.to_string()))?;
    let (model, settings) = (model.clone(), settings.clone());
    let mut agent = Agent::from_parameters(model, settings, compute, networks)?;
    agent
        .restore_progress(state.updates, state.adam_step, moments)
        .map_err(|why| damaged(path, OPTIMIZER, why.to_string()))?;
    Ok(Restored {
        agent,
        affinity: state.affinity,
        rng: state.rng,
        weights_version: state.weights_version,
    })
}

fn io_error<'a>(
    what: &'static str,
    path: &'a Path,
) -> impl FnOnce(io::Error) -> CheckpointError + 'a {
    move |why| CheckpointError::Io {
        what,
        path: path.to_owned(),
        why,
    }
}

fn damaged(folder: &Path, file: &str, why: String) -> CheckpointError {
    CheckpointError::Damaged {
        file: folder.join(file),
        why,
    }
}

fn read(path: &Path) -> Result<Vec<u8>, CheckpointError> {
    fs::read(path).map_err(|why| match why.kind() {
        io::ErrorKind::NotFound => CheckpointError::Damaged {
            file: path.to_owned(),
            why: "it is missing".to_owned(),
        },
        _ => io_error("read", path)(why),
    })
}

/// Writes a file aside, flushes it to disk and gives it its name.
fn write_durably(path: &Path, bytes: &[u8]) -> Result<(), CheckpointError> {
    let mut aside = path.as_os_str().to_owned();
    aside.push(".tmp");
    let aside = PathBuf::from(aside);
    let mut file = File::create(&aside).map_err(io_error("create", &aside))?;
    file.write_all(bytes)
        .and_then(|()| file.sync_all())
        .map_err(io_error("write", &aside))?;
    fs::rename(&aside, path).map_err(io_error("move", &aside))
}

/// Flushes a folder's own entries to disk.
fn sync(folder: &Path) -> Result<(), CheckpointError> {
    File::open(folder)
        .and_then(|folder| folder.sync_all())
        .map_err(io_error("flush", folder))
}

fn remove_if_there(folder: &Path) -> Result<(), CheckpointError> {
    match fs::remove_dir_all(folder) {
        Err(why) if why.kind() != io::ErrorKind::NotFound => Err(io_error("remove", folder)(why)),
        _ => Ok(()),
    }
}

fn sha256_of(bytes: &[u8]) -> String {
    Sha256::digest(bytes)
        .iter()
        .map(|byte| format!("{byte:02x}"))
        .collect()
}

fn hex_of(hash: u64) -> String {
    format!("{hash:016x}")
}
