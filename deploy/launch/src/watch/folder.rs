//! The folder that `driml watch --run-dir` writes: begun, or continued where it holds the same run.
//! Checkpoints are the learner's, which may write them into the same folder.

use std::{fs, io::ErrorKind};

use anyhow::Context;
use driml_machine::error::usage;
use driml_settings::config::RunConfig;

use crate::{
    launcher::process_names,
    run_folder::{Recorded, ResumePoint, RunFolder, RunRecorder, Table},
    run_view::RunView,
};

/// Begins to record the run in `folder`, or continues.
pub(super) fn record(
    folder: &RunFolder,
    config: &RunConfig,
    view: &RunView,
) -> anyhow::Result<RunRecorder> {
    let recorded = Recorded::of(config, process_names(config));
    // A learner may have just begun there.
    let is_run_s = folder.config().exists() || folder.checkpoints().is_dir();
    let mut recorder = match is_run_s {
        false => RunRecorder::create(folder, recorded)?,
        true => {
            check_same(folder, config)?;
            let point = resume_point(folder, view)?;
            RunRecorder::go_on(folder, recorded, point, u64::MAX).map_err(|e| in_use(folder, e))?
        }
    };
    recorder.count_seconds_from(view.up_s().unwrap_or(0.0));
    Ok(recorder)
}

/// Says so if another command writes there.
fn in_use(folder: &RunFolder, e: anyhow::Error) -> anyhow::Error {
    match folder.lock() {
        Ok(_) => e,
        Err(_) => usage!(
            "{} is written by `driml train` or by another `driml watch`: watch without --run-dir, or choose another folder",
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
fn resume_point(folder: &RunFolder, view: &RunView) -> anyhow::Result<ResumePoint> {
    let path = folder.metrics();
    let text = fs::read(&path).unwrap_or_default();
    let rows = Table::parse(&text).with_context(|| format!("reading {}", path.display()))?;
    let last = |name| rows.last::<u64>(name).unwrap_or(0);
    let (frames, updates) = (last("frames"), last("updates"));
    let now = view.replay.transitions_inserted;
    let after_updates = view.after_updates.unwrap_or(0);
    if after_updates == 0 && frames > now {
        return Err(usage!(
            "the run in {} had {frames} frames, and the watched run has {now}: it was restarted; choose another --run-dir",
            folder.display()
        )
        .into());
    }
    Ok(ResumePoint {
        // A run that was resumed makes the updates since its checkpoint again.
        updates: match after_updates {
            0 => updates,
            _ => updates.min(view.learner.updates),
        },
        rows: view.replay.rows_sampled,
        frames: now,
        replay_is_kept: after_updates == 0,
    })
}
