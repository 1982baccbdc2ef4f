//! Runs actors, replay and learner in one process, one after the other in a fixed order: the same code as in separate processes, but
//! without sockets. The same seed gives the same weights, bit for bit, on the same machine. The mode is for tests and debugging.
//!
//! A resumed run continues as if it had not been interrupted: each checkpoint holds the state of worlds, actors and replay.

mod processes;
#[cfg(test)]
mod tests;

use std::time::{Duration, Instant};

use anyhow::Context;
use driml_machine::units::count;
use driml_protocol::{GracefulShutdown, Shutdown, spawn};
use driml_settings::config::RunConfig;

use crate::{
    checkpoint_choice::CheckpointChoice,
    console::{self, Screen},
    evaluator::{EvaluationSchedule, evaluate_and_keep},
    resume,
    run_folder::{Outcome, ResumePoint, RunFolder, RunRecorder},
    run_view::{Plan, RunView},
    view::Display,
};
use processes::Lockstep;

const POLL: Duration = Duration::from_secs(1);
/// Rows of metrics that even the shortest run has, evenly over its frames, as such a run may last less than a second.
const ROWS_MIN: u64 = 200;

/// Trains in this process, and leaves the folder `run_dir`. With a resume point, continues the run in that folder.
///
/// # Errors
/// A component that failed, a file system error; `Interrupted` if the run was asked to stop.
pub fn run(
    config: &RunConfig,
    run_dir: &RunFolder,
    resumed: Option<ResumePoint>,
    exit_with_parent: Option<u32>,
) -> anyhow::Result<()> {
    let shutdown = GracefulShutdown::on_repeated_signals(exit_with_parent);
    let GracefulShutdown { drain, immediate } = shutdown.context("listening for signals")?;
    let mut display = Display::new(config.frames(), Instant::now());
    let screen = display.screen.clone();
    watch_interrupts(drain.clone(), immediate, screen.clone())?;
    let mut schedule = EvaluationSchedule::new(config, run_dir)?;
    let events = config.local.tensorboard;
    // A state that does not fit the settings is an error before the folder changes.
    let restored = resumed
        .map(|_| Lockstep::resume(config, run_dir))
        .transpose()?;
    let mut recorder = RunRecorder::open(run_dir, config, Vec::new(), resumed, events)?;
    let mut lockstep = match restored {
        Some(restored) => restored,
        None => Lockstep::begin(config, run_dir)?,
    };
    let point = resumed.unwrap_or_default();
    let (frames, updates) = (point.frames, point.updates);
    let mut view = RunView::new(Plan::new(config));
    view.begin_at(frames, updates);
    let mut evaluate = |updates, is_last| {
        let Some(episodes) = schedule.take_episodes(updates, is_last) else {
            return;
        };
        let choice = CheckpointChoice::After(updates);
        match evaluate_and_keep(run_dir, choice, episodes, &drain) {
            Ok((evaluation, _)) => screen.print_line(&evaluation.describe()),
            Err(_) if drain.is_set() => screen.print_line("skipped an evaluation"),
            Err(e) => screen.print_line(&format!("the run continues without an evaluation: {e:#}")),
        }
    };
    let mut shown_at = Instant::now();
    let row_frames = (config.frames() / ROWS_MIN).max(1);
    let mut row_number = lockstep.replay.inserted_total() / row_frames;
    let folder = run_dir.checkpoints();

    let mut saved = resumed.map(|point| (point.updates, point.frames));
    let mut save_tried_at = updates;
    // A round may take several updates.
    let period = config.learner.checkpoint_period_updates;
    let mut train = || {
        let outcome = loop {
            if drain.is_set() {
                break Outcome::Interrupted;
            }
            if !lockstep.run_round()? {
                break Outcome::Finished;
            }
            let updates = lockstep.learner.updates();
            if updates / period > save_tried_at / period {
                save_tried_at = updates;
                // A failed save does not end the training, but at the end of the run it is an error.
                if let Err(e) = lockstep.save(&folder) {
                    let updates = count(updates, "update");
                    screen.print_line(&format!(
                        "no checkpoint after {updates}, retrying at the next period: {e:#}"
                    ));
                } else {
                    saved = Some((updates, lockstep.replay.inserted_total()));
                    evaluate(updates, false);
                }
            }
            let show = shown_at.elapsed() >= POLL;
            if show || lockstep.replay.inserted_total() / row_frames > row_number {
                row_number = lockstep.replay.inserted_total() / row_frames;
                screen.print_lines(record(&mut recorder, &mut view, &mut lockstep));
                if show {
                    shown_at = Instant::now();
                    display.show(&view);
                }
            }
        };
        // Frames may have been stored since the last update.
        let reached = Some((lockstep.learner.updates(), lockstep.replay.inserted_total()));
        if saved != reached || outcome == Outcome::Interrupted {
            lockstep.save(&folder)?;
        }
        // Only after the last save: a longer run must continue from a state in which the actors have not left.
        lockstep.finish().map(|()| outcome)
    };
    let ended = train();
    screen.clear();
    record(&mut recorder, &mut view, &mut lockstep);
    if matches!(ended, Ok(Outcome::Finished)) {
        evaluate(lockstep.learner.updates(), true);
    }
    let missing = console::join_losses(recorder.loss_messages());
    missing.iter().for_each(|line| console::eprintln(line));
    let ended = ended.and_then(|outcome| run_dir.check_intact().map(|()| outcome));
    let outcome = *ended.as_ref().unwrap_or(&Outcome::Failed);
    let summary = recorder.summarise(outcome, &mut view);
    let written = summary.write(run_dir);
    resume::report_end(ended, written, &summary, resumed, &config.world, run_dir)?;
    resume::print_next_steps(&summary, &config.world, run_dir)
}

/// Reports the first interrupt, because the round in progress may wait for a world for long. Exits at the second.
fn watch_interrupts(first: Shutdown, second: Shutdown, screen: Screen) -> anyhow::Result<()> {
    let watch = move || {
        first.wait();
        screen.print_line("stopping (Ctrl-C again exits at once)");
        second.wait();
        let error = "error: stopped at once by a second interrupt: what was not saved is lost";
        screen.print_line(error);
        std::process::exit(1);
    };
    spawn("end", watch).context("starting a thread").map(drop)
}

/// Records the state of the run, and the episodes that ended. Returns warnings.
fn record(recorder: &mut RunRecorder, view: &mut RunView, lockstep: &mut Lockstep) -> Vec<String> {
    let status = lockstep.replay.status();
    let ended = status.episodes;
    view.set_learner(Some(lockstep.turn.status.clone()));
    view.set_replay(vec![status]);
    let fetch = |_, since| Some(lockstep.replay.episodes_since(since));
    let mut warnings = recorder.record_episodes(view, fetch);
    warnings.extend(recorder.record(view, &[]));
    lockstep.replay.set_recorded_episodes(ended);
    warnings
}
