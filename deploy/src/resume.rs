//! `driml local --resume`: the settings of an interrupted run, and what it has behind it.
//! It changes nothing in the run's folder, and waits there for whoever still saves.

use std::{
    path::Path,
    time::{Duration, Instant},
};

use anyhow::Context;
use driml_envs::WorldConfig;
use driml_learner::checkpoint::{self, CheckpointError};

use crate::{
    config::{Flags, RunConfig, Source, resolve},
    error::{Usage, usage},
    machine::Machine,
    record,
};

/// How long the learner of a launcher that was killed may take to save.
const SAVING_MAX: Duration = Duration::from_secs(120);

/// What a run has behind it when it starts: nothing, or what its newest checkpoint has learned.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct Behind {
    /// Updates done.
    pub(crate) updates: u64,
    /// Frames that these updates needed, the warm-up included.
    pub(crate) frames: u64,
}

/// Whether a run in this world can be resumed: a checkpoint holds nothing of a world's own progress.
pub(crate) const fn can_go_on(world: &WorldConfig) -> bool {
    !matches!(world, WorldConfig::MsPacman(world) if world.lethal_schedule.is_some())
}

/// The settings with which the run in `folder` goes on, and what it has behind it.
///
/// # Errors
/// A folder that is no run's, settings that cannot work, no checkpoint, nothing left to do, a learner that still saves.
pub(crate) fn find(
    folder: &Path,
    flags: &Flags,
    machine: &Machine,
) -> anyhow::Result<(RunConfig, Behind)> {
    let path = folder.join("config.toml");
    let name = path.display().to_string();
    let text = std::fs::read_to_string(&path).map_err(|e| {
        usage!(
            "reading the settings {name}: {e}; --resume takes the folder of a run that was interrupted"
        )
    })?;
    let config = resolve(&Source::File(name, text), flags, machine)?;
    // Whether somebody is at it is asked here, and again when the run starts.
    record::lock(folder)?;
    if !can_go_on(&config.world) {
        return Err(usage!(
            "the ghosts of the run in {} change as episodes pass, and a checkpoint does not hold how far they are: start it anew",
            folder.display()
        )
        .into());
    }
    let updates = newest(&folder.join("checkpoints"))?;
    if updates >= config.updates() {
        return Err(usage!(
            "the run in {} is finished, {updates} updates for {} frames: to train on, add --frames with more than these",
            folder.display(),
            config.frames()
        )
        .into());
    }
    if updates == 0 {
        return Ok((config, Behind::default()));
    }
    let rows = updates as f64 * f64::from(config.learner.batch_rows);
    let frames =
        config.replay.warmup_transitions + (rows / config.replay.replay_ratio).ceil() as u64;
    Ok((config, Behind { updates, frames }))
}

/// Updates of the newest checkpoint in `folder`, when nobody saves there any more.
fn newest(folder: &Path) -> anyhow::Result<u64> {
    let none = || -> Usage {
        usage!(
            "there is no checkpoint in {}: start the run anew, in another folder",
            folder.display()
        )
    };
    if !folder.is_dir() {
        return Err(none().into());
    }
    let started = Instant::now();
    loop {
        match checkpoint::lock(folder) {
            Err(CheckpointError::InUse(_)) if started.elapsed() < SAVING_MAX => {
                if started.elapsed() < Duration::from_secs(1) {
                    eprintln!("a learner still saves in {}: waiting", folder.display());
                }
                std::thread::sleep(Duration::from_secs(1));
            }
            locked => {
                locked?;
                break;
            }
        }
    }
    let all = checkpoint::list(folder).context("looking for checkpoints")?;
    let (updates, _) = all.last().ok_or_else(none)?;
    Ok(*updates)
}
