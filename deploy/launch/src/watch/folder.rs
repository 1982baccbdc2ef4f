//! The folder that `driml watch --run-dir` writes: begun, or gone on with where it holds the same run.
//! Checkpoints are the learner's, which may write them into the same folder.

use std::{fs, io::ErrorKind};

use anyhow::Context;
use driml_machine::error::{Usage, usage};
use driml_protocol::{LearnerStatus, ReplayStatus};
use driml_settings::config::RunConfig;

use crate::{
    launcher::process_names,
    run_folder::{Columns, Recorded, ResumePoint, RunFolder, RunRecorder},
};

/// How far a run is when it is found.
pub(super) struct Found<'a> {
    pub(super) config: &'a RunConfig,
    /// Updates after which it was resumed.
    pub(super) after_updates: u64,
    pub(super) replay: &'a ReplayStatus,
    pub(super) learner: &'a LearnerStatus,
    /// Seconds for which it has been going on.
    pub(super) up_s: f64,
}

/// Begins to record the run in `folder`, or goes on.
///
/// # Errors
/// A folder of something else, or into which somebody else writes; a file system that refuses.
pub(super) fn record(folder: &RunFolder, run: &Found<'_>) -> anyhow::Result<RunRecorder> {
    let recorded = Recorded::of(run.config, process_names(run.config));
    // A learner may have just begun there.
    let is_run_s = folder.config().exists() || folder.checkpoints().is_dir();
    let mut recorder = match is_run_s {
        false => RunRecorder::create(folder, recorded)?,
        true => {
            check_same(folder, run.config)?;
            let point = resume_point(folder, run)?;
            RunRecorder::go_on(folder, recorded, point, u64::MAX).map_err(|e| in_use(folder, e))?
        }
    };
    recorder.count_seconds_from(run.up_s);
    Ok(recorder)
}

/// Whoever runs or watches there is no mistake of the folder's.
fn in_use(folder: &RunFolder, e: anyhow::Error) -> anyhow::Error {
    match folder.lock() {
        Ok(_) => e,
        Err(_) => usage!(
            "{} is written by `driml train` or by another `driml watch`: leave --run-dir out to look on, or choose another folder",
            folder.display()
        )
        .into(),
    }
}

/// Refuses the folder of a run with other settings.
fn check_same(folder: &RunFolder, config: &RunConfig) -> anyhow::Result<()> {
    let path = folder.config();
    let name = path.display().to_string();
    let text = match fs::read_to_string(&path) {
        Err(e) if e.kind() == ErrorKind::NotFound => return Ok(()),
        read => read.with_context(|| format!("reading {name}"))?,
    };
    let there = RunConfig::parse(&name, &text)?.run;
    if there.hash() == config.run.hash() {
        return Ok(());
    }
    Err(usage!(
        "{} holds another run ({} with {}, seed {}) than the one that is watched ({} with {}, seed {}): choose another --run-dir",
        folder.display(),
        there.world,
        there.agent,
        there.seed,
        config.run.world,
        config.run.agent,
        config.run.seed,
    )
    .into())
}

/// Which of the rows that are there stay.
fn resume_point(folder: &RunFolder, run: &Found<'_>) -> anyhow::Result<ResumePoint> {
    let text = fs::read(folder.metrics()).unwrap_or_default();
    let path = folder.metrics();
    let rows = Columns::parse(&text).with_context(|| format!("reading {}", path.display()))?;
    let last = |name| rows.last::<u64>(name).unwrap_or(0);
    let (frames, updates) = (last("frames"), last("updates"));
    let now = run.learner.updates.max(run.after_updates);
    if run.after_updates == 0 && frames > run.replay.transitions_inserted {
        return Err(further(folder, frames, run.replay.transitions_inserted).into());
    }
    Ok(ResumePoint {
        // A run that was resumed makes the updates since its checkpoint again.
        updates: match run.after_updates {
            0 => updates,
            _ => updates.min(now),
        },
        rows: run.replay.rows_sampled,
        frames: run.replay.transitions_inserted,
        replay_is_kept: run.after_updates == 0,
    })
}

fn further(folder: &RunFolder, frames: u64, now: u64) -> Usage {
    usage!(
        "the run in {} was at {frames} frames, and the one that is watched is at {now}: it was started anew, so choose another --run-dir",
        folder.display()
    )
}
