//! Actors, replay server and learner in one process, one after the other in a fixed order: the same code as the processes run,
//! without sockets. The same seed gives the same weights, bit for bit, on the same machine; it is for tests and debugging, not for speed.
//!
//! A run that was interrupted goes on as if it had not been: with each checkpoint it keeps how worlds, actors and replay stand.

mod parts;
mod saved;
#[cfg(test)]
mod tests;

use std::time::{Duration, Instant};

use anyhow::Context;
use driml_machine::error::Interrupted;
use driml_protocol::Shutdown;
use driml_settings::config::RunConfig;

use crate::{
    console::{self, Screen, print},
    live_view::{Display, TEMPLATE},
    resume,
    run_folder::{Outcome, ResumePoint, RunFolder, RunRecorder},
};
use parts::Lockstep;

/// How often progress is shown and recorded.
const POLL: Duration = Duration::from_secs(1);

/// Trains in this process, and leaves `run_dir`; with a resume point it goes on with the run that is there.
///
/// # Errors
/// A component that failed, a file system that refuses; [`Interrupted`] if the run was asked to stop.
pub fn run(
    config: &RunConfig,
    run_dir: &RunFolder,
    resumed: Option<ResumePoint>,
    exit_with_parent: Option<u32>,
) -> anyhow::Result<()> {
    let shutdown = Shutdown::on_signals(exit_with_parent).context("listening for signals")?;
    let (text, losses) = (config.to_toml(), config.learner.update.objective.losses());
    let mut recorder = match resumed {
        Some(point) => RunRecorder::go_on(run_dir, &text, losses, &[], point, config.frames())?,
        None => RunRecorder::create(run_dir, &text, losses, &[])?,
    };
    if config.local.tensorboard {
        recorder.write_events(run_dir)?;
    }
    let screen = Screen::new(config.frames(), TEMPLATE);
    let mut lockstep = match resumed {
        Some(_) => Lockstep::resume(config, run_dir)?,
        None => Lockstep::begin(config, run_dir)?,
    };
    let mut display = Display::new(
        screen.clone(),
        config.frames(),
        config.updates(),
        resumed.unwrap_or_default(),
    );
    let mut shown = Instant::now();
    let folder = run_dir.checkpoints();

    let mut outcome = Outcome::Finished;
    let mut saved = resumed.map(|point| point.updates);
    // A round may take several updates.
    let period = config.learner.checkpoint_period_updates;
    while lockstep.round()? {
        if lockstep.updates() / period > saved.unwrap_or(0) / period {
            saved = Some(lockstep.updates());
            lockstep.save(&folder)?;
        }
        if shown.elapsed() >= POLL {
            shown = Instant::now();
            let (replay, status) = lockstep.status();
            let said = recorder.record(std::slice::from_ref(&replay), status, &[]);
            said.iter().for_each(|line| screen.line(line));
            display.show(&replay, status, recorder.episodes(&replay), &[]);
        }
        if shutdown.is_set() {
            outcome = Outcome::Interrupted;
            break;
        }
    }
    if saved != Some(lockstep.updates()) || outcome == Outcome::Interrupted {
        lockstep.save(&folder)?;
    }
    // After the last save: a longer run would go on from there without it.
    lockstep.end()?;
    screen.clear();
    let (replay, status) = lockstep.status();
    recorder.record(std::slice::from_ref(&replay), status, &[]);
    let missing = recorder.missing();
    missing.iter().for_each(|line| console::line(line));
    let summary = recorder.summarise(outcome, &config.run, &replay, status);
    print(&summary.describe(run_dir))?;
    summary.write(run_dir)?;
    if outcome == Outcome::Interrupted {
        resume::say_how(&config.world, run_dir);
        Err(Interrupted.into())
    } else {
        print(&summary.next_steps(run_dir))
    }
}
