//! `driml train --resume`: finds the settings of an interrupted run, and the point from which it continues.
//! This module changes nothing in the run's folder. It waits until an earlier learner has saved there.

use std::{ffi::OsStr, os::unix::ffi::OsStrExt, path::Path, time::Duration};

use anyhow::{Context, bail};
use driml_envs::WorldConfig;
use driml_learner::{
    DeviceName, Learner, LearnerConfig,
    checkpoint::{self, CheckpointError},
};
use driml_machine::{
    error::{Interrupted, usage},
    resources::Machine,
    units::count,
};
use driml_protocol::{Sampling, Silence};
use driml_replay_server::{RatioStart, kept_size};
use driml_settings::{
    config::RunConfig,
    flags::{Flags, Source},
};

use crate::{
    checkpoint_choice::read_config,
    console, rendezvous,
    run_folder::{Outcome, ResumePoint, RunFolder, Summary},
};

/// How long the learner may take to save after its launcher was killed, also if it retries on a full disk.
const SAVING_MAX: Duration = Duration::from_secs(120 + checkpoint::RETRY_MAX.as_secs());
/// How long the other processes may then take to exit; a replay server stays for 25 s if one of them is frozen.
const ENDING_MAX: Duration = Duration::from_secs(35);
const WAIT_POLL: Duration = Duration::from_millis(250);

/// Whether the run in `folder`, which plays `world`, can be resumed. It needs a checkpoint, and a world that keeps no progress across
/// episodes or whose progress the checkpoint holds.
pub fn is_resumable(world: &WorldConfig, folder: &RunFolder) -> bool {
    folder.config().exists()
        && folder.newest_checkpoint().is_some_and(|(_, newest)| {
            let companion = checkpoint::read_companion(&newest).unwrap_or_default();
            companion.map_or_else(|| world.is_resumable(), |it| !it.is_empty())
        })
}

/// Prints how to resume a run that was interrupted or failed, if that is possible, or that it has to start again.
fn print_resume_hint(world: &WorldConfig, folder: &RunFolder) {
    if is_resumable(world, folder) {
        console::eprintln(&format!(
            "`driml train --resume {}` resumes it",
            folder.quoted()
        ));
    } else if folder.config().exists() && folder.newest_checkpoint().is_none() {
        console::eprintln("there is no checkpoint yet: start the run again");
    }
}

/// Reports how a run `ended`, whose summary was `written` or not. After a failure, the caller reports that error last.
///
/// # Errors
/// The run's own error, or the summary could not be written.
pub(crate) fn report_end(
    ended: anyhow::Result<Outcome>,
    written: anyhow::Result<()>,
    summary: &Summary,
    resumed: Option<ResumePoint>,
    world: &WorldConfig,
    folder: &RunFolder,
) -> anyhow::Result<()> {
    if let Err(failed) = ended {
        if let Err(e) = written {
            console::eprintln(&console::describe_error(&e));
        }
        // A resumed run that did no update most likely failed because of what it was resumed from, and would fail again.
        if resumed.is_none_or(|point| summary.updates > point.updates) {
            print_resume_hint(world, folder);
        }
        return Err(failed);
    }
    console::print_wrapped(&summary.describe(folder), 2)?;
    written.with_context(|| {
        format!(
            "the run is over and its checkpoint saved, but the summary could not be written: make room on the disk, or make the folder \
             writable, then run `driml train --resume {}`",
            folder.quoted()
        )
    })
}

/// Prints what the user can do after a run has ended: commands, or how to resume it. Fails as [`Interrupted`] if the run was interrupted.
pub(crate) fn print_next_steps(
    summary: &Summary,
    world: &WorldConfig,
    folder: &RunFolder,
) -> anyhow::Result<()> {
    if summary.outcome == Outcome::Interrupted {
        print_resume_hint(world, folder);
        return Err(Interrupted.into());
    }
    // A description that does not fit beside its command stands below it.
    console::print_wrapped(&summary.next_steps(folder, is_resumable(world, folder)), 6)
}

/// Waits until the learner of an ended run in `folder` has saved and the other processes of the run have exited.
///
/// # Errors
/// The run is still running, or its learner takes too long.
pub fn wait_until_free(folder: &RunFolder) -> anyhow::Result<()> {
    folder.lock()?;
    let checkpoints = folder.checkpoints();
    let lock = || checkpoints.is_dir().then(|| checkpoint::lock(&checkpoints));
    let is_saved = || !matches!(lock(), Some(Err(CheckpointError::InUse(_))));
    let why = format!(
        "a learner still uses {} (stop it if it runs with --keep-alive)",
        checkpoints.display()
    );
    wait_until(is_saved, SAVING_MAX, &why);
    lock().transpose()?;
    // The replay server exits last: until then it holds its replay and its endpoint.
    let have_exited = || {
        let place = std::fs::read(folder.rendezvous());
        let is_used = |place: Vec<u8>| rendezvous::is_used(Path::new(OsStr::from_bytes(&place)));
        !place.is_ok_and(is_used)
    };
    let why = format!("processes of the run in {} are exiting", folder.display());
    wait_until(have_exited, ENDING_MAX, &why);
    Ok(())
}

/// Waits until `is_done` returns true, for at most `max`, and prints `why` if it has to wait. A time in which this process was stopped
/// hardly counts: a replay server that was stopped with it does not count that time either.
fn wait_until(is_done: impl Fn() -> bool, max: Duration, why: &str) {
    let mut waited = Silence::with_gap_max(2 * WAIT_POLL);
    let mut is_reported = false;
    while !is_done() && waited.record_failure() < max {
        if !std::mem::replace(&mut is_reported, true) {
            console::eprintln(&format!("{why}: waiting"));
        }
        std::thread::sleep(WAIT_POLL);
    }
}

/// Whether and how a run can be resumed.
#[derive(Debug)]
pub enum Resumption {
    /// Nothing is left to do. The text says so, and what else can be done.
    Done(String),
    /// Something is left to do, or the run has all its updates but did not come to its end.
    Resumed(Box<ResumedRun>),
}

/// What a resumed run continues with.
#[derive(Debug)]
pub struct ResumedRun {
    /// The run's settings.
    pub config: RunConfig,
    /// The point from which the run continues.
    pub point: ResumePoint,
    /// Whether all components run in one process, in a fixed order.
    pub lockstep: bool,
}

/// Checks that the run in `folder` can change its settings from `before` to `config`, which its newest checkpoint must fit. The check
/// comes before `config` is written into the folder, as a run with settings that cannot work could not be resumed afterwards.
fn check_changes(
    folder: &RunFolder,
    before: &RunConfig,
    config: &RunConfig,
    lockstep: bool,
) -> anyhow::Result<()> {
    if let Some(key) = before.first_change_of_task(config) {
        bail!(usage!(
            "{key} cannot change in a run: resume without this --set"
        ));
    }
    let compute = DeviceName::Cpu.open(config.learner.precision)?;
    let learner = LearnerConfig::from_toml(&config.to_toml())
        .and_then(|settings| Learner::new(settings, &compute))
        .map_err(|e| usage!("{e}"))?;
    match learner.resume(&folder.checkpoints()) {
        Err(e @ (CheckpointError::Damaged { .. } | CheckpointError::Io { .. })) => bail!(e),
        resumed => resumed.map_err(|e| usage!("{e}"))?,
    };
    let (actors_before, actors) = (before.local.actors, config.local.actors);
    if lockstep && actors_before != actors {
        bail!(usage!(
            "local.actors = {actors}, but this run in lockstep has {actors_before}: resume with as many"
        ));
    }
    let replay = folder.replay();
    let [shards_before, shards] = [before, config].map(|it| it.replay.shards);
    if config.local.durable && replay.is_dir() && shards_before != shards {
        bail!(usage!(
            "replay.shards = {shards}, but {} holds the transitions of {}: resume without this --set, or remove that folder",
            replay.display(),
            count(shards_before, "shard")
        ));
    }
    let is_durable = config.local.durable && !lockstep;
    let lost = (0..shards).filter(|&shard| kept_size(&replay, shard, shards).is_none());
    let lost: Vec<_> = lost.collect();
    if is_durable && (1..shards as usize).contains(&lost.len()) {
        bail!(usage!(
            "{} has no log of shard {}: remove that folder, then resume",
            replay.display(),
            lost[0]
        ));
    }
    if is_durable && !before.local.durable && replay.is_dir() {
        bail!(usage!(
            "{} lacks what the run stored later, without --durable: remove that folder, then resume",
            replay.display()
        ));
    }
    Ok(())
}

/// Finds the settings with which the run in `folder` continues, and the point from which it continues.
///
/// # Errors
/// The folder is not a run's, the settings cannot work, it has no checkpoint, or the run is still running.
pub fn prepare(folder: &RunFolder, flags: &Flags) -> anyhow::Result<Resumption> {
    let before = read_config(folder)?;
    // A run that is still exiting holds memory.
    wait_until_free(folder)?;
    let checkpoints = folder.checkpoints();
    let all = checkpoint::list(&checkpoints).context("looking for checkpoints")?;
    let (_, newest) = all.last().with_context(|| {
        let checkpoints = checkpoints.display();
        usage!("there is no checkpoint in {checkpoints}: start the run again, in another folder")
    })?;
    let (updates, counts) = checkpoint::read_run_counts(newest)?;
    let mut flags = flags.clone();
    if updates > 0 {
        // The run has had its first batch, so fewer frames leave it complete, too.
        flags.frames = flags.frames.map(|it| it.max(before.frames_min()));
    }
    let source = Source::File(folder.config().display().to_string(), before.to_toml());
    let mut config = source.resolve(&flags, &Machine::detect())?;
    // A run in lockstep has a companion, which is empty if the state of its world cannot be saved.
    let companion = checkpoint::read_companion(newest)?;
    if companion.as_ref().is_some_and(Vec::is_empty) {
        bail!(usage!(
            "the run in {} cannot be resumed, because the state of its world cannot be saved: start it again",
            folder.display()
        ));
    }
    let lockstep = companion.is_some();
    if !lockstep && !config.world.is_resumable() {
        bail!(usage!(
            "the run in {} cannot be resumed, because a checkpoint does not save its position in world.lethal_schedule: start it again",
            folder.display()
        ));
    }
    check_changes(folder, &before, &config, lockstep)?;
    let shards = config.replay.shards;
    let has_log = |shard| kept_size(&folder.replay(), shard, shards).is_some();
    let replay_is_kept = lockstep || config.local.durable && (0..shards).all(has_log);
    // Before the first update, a run without its replay begins anew.
    let (frames, rows) = match updates {
        0 if !replay_is_kept => (0, 0),
        _ => (counts.frames(), counts.rows()),
    };
    let has_pace_changed = before.learner.batch_size != config.learner.batch_size
        || before.replay.replay_ratio != config.replay.replay_ratio
        || before.replay.warmup_transitions != config.replay.warmup_transitions;
    // Checkpoints after an earlier change may have been removed.
    if has_pace_changed || config.replay.since.is_some_and(|it| it.updates > updates) {
        config.replay.since = (updates > 0).then_some(RatioStart {
            transitions: frames,
            rows,
            updates,
        });
    }
    let is_complete = updates >= config.updates();
    // The last chunk is stored whole, so a run may have more frames than planned.
    let is_shortened = config.frames() < frames.min(before.frames());
    if is_complete && (is_shortened || Summary::is_finished(folder)) {
        let (run, updates) = (folder.quoted(), count(updates, "update"));
        let frames = count(frames, "frame");
        let unused = match flags.sets.is_empty() {
            true => "",
            false => ", so the changed settings have no effect",
        };
        return Ok(Resumption::Done(format!(
            "nothing is left to do: the run in {run} has done {updates} and {frames}{unused}.\n\
             `driml evaluate {run}` plays it; `driml train --resume {run} --frames N` trains it up to N frames"
        )));
    }
    let alpha = |it: &RunConfig| match it.replay.sampling {
        Sampling::Prioritised { alpha, .. } => Some(alpha),
        Sampling::Uniform {} => None,
    };
    if replay_is_kept
        && let [Some(old), Some(new)] = [&before, &config].map(alpha)
        && old != new
    {
        bail!(usage!(
            "replay.sampling.alpha = {new}, but the replay that is kept has its priorities to the power of {old}: resume without this --set"
        ));
    }
    let point = ResumePoint {
        updates,
        rows,
        frames,
        replay_is_kept,
        after_updates: updates,
        // A run in lockstep repeats what follows its checkpoint; before the first update only frames tell that.
        frames_max: match lockstep && updates == 0 {
            true => frames,
            false => config.frames(),
        },
    };
    Ok(Resumption::Resumed(Box::new(ResumedRun {
        config,
        point,
        lockstep,
    })))
}

#[cfg(test)]
mod tests {
    use std::cell::Cell;

    use super::*;

    #[test]
    fn the_time_in_which_this_process_was_stopped_hardly_counts() {
        let checks = Cell::new(0);
        let is_done = || {
            checks.set(checks.get() + 1);
            if checks.get() == 1 {
                std::thread::sleep(5 * WAIT_POLL);
            }
            checks.get() == 2
        };
        wait_until(is_done, 4 * WAIT_POLL, "a process is exiting");
        assert_eq!(checks.get(), 2);
    }
}
