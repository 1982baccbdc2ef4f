//! Evaluates a run's checkpoints and keeps the best: `keep` evaluates one in this process, `Evaluator` starts a process for each.
//! `driml evaluate` measures the best on other episodes, as the best of many checkpoints is partly the luckiest.

use std::{
    ffi::OsStr,
    path::Path,
    time::{Duration, Instant},
};

use driml_learner::checkpoint;
use driml_machine::{error::Interrupted, units::count};
use driml_protocol::Shutdown;
use driml_settings::config::{EvaluationConfig, RunConfig};

use crate::{
    checkpoint_choice::{CheckpointChoice, WeightsChoice, checkpoint_path, read_config},
    console::Screen,
    evaluate::{Levels, Player, PolicyKind},
    managed_process::{ManagedProcess, program_command},
    output::check_file,
    run_folder::{Candidate, EvaluationRow, RunFolder},
    stats::mean_and_deviation,
};

/// The seed of the episodes on which checkpoints are compared; reports use other seeds.
pub const SELECTION_SEED: u64 = 1 << 32;

/// Plays a checkpoint of a run on the training levels, with averaged weights if it has them. Adds the evaluation to the run's table, and
/// keeps the checkpoint if it earned more than the best before it.
///
/// Both are compared over the same episodes. A best checkpoint that was played for fewer episodes is played again. A checkpoint that is
/// played for fewer episodes than the best does not replace it. Returns the evaluation and its rank, as the end of a sentence.
///
/// # Errors
/// A file system error; [`Interrupted`] once `shutdown` is raised: then nothing is kept.
pub fn evaluate_and_keep(
    folder: &RunFolder,
    choice: CheckpointChoice,
    episodes: u32,
    shutdown: &Shutdown,
) -> anyhow::Result<(EvaluationRow, String)> {
    let path = checkpoint_path(folder, choice)?;
    check_file("the table", &folder.evaluations())?;
    let candidate = Candidate::read(&path)?;
    let evaluate = |path: &Path| -> anyhow::Result<EvaluationRow> {
        let player = Player::load_checkpoint(read_config(folder)?, path, WeightsChoice::default())?;
        let (agent, count) = (PolicyKind::Agent, episodes as usize);
        let is_over = || shutdown.is_set();
        let returns = player.returns(agent, Levels::Train, count, SELECTION_SEED, is_over)?;
        if returns.len() < count {
            return Err(Interrupted.into());
        }
        let stats = mean_and_deviation(&returns);
        Ok(EvaluationRow::new(folder, player.updates, episodes, stats))
    };
    let evaluation = evaluate(&path)?;
    let mut best_before = EvaluationRow::best(folder)?;
    let is_short = |it: &EvaluationRow| it.updates != evaluation.updates && it.episodes < episodes;
    if best_before.is_some_and(|it| is_short(&it))
        && let Some((_, best)) = checkpoint::list(&folder.best())?.pop()
    {
        let again = evaluate(&best)?;
        again.append_to(folder)?;
        best_before = Some(again);
    }
    let is_best = candidate.keep_if_best(folder, &evaluation)?;
    let rank = match best_before {
        _ if is_best => ", the best so far".into(),
        Some(best) if best.episodes > episodes => format!(
            "; the best checkpoint stays, as its mean is over {}",
            count(best.episodes, "episode")
        ),
        _ => String::new(),
    };
    Ok((evaluation, rank))
}

const LAST_EVALUATION_MAX: Duration = Duration::from_secs(3600);
const POLL: Duration = Duration::from_millis(100);

pub(crate) struct EvaluationSchedule {
    config: Option<EvaluationConfig>,
    /// Updates of the newest checkpoint that was evaluated or is being evaluated.
    newest: u64,
}

impl EvaluationSchedule {
    /// The checkpoints that are newer than those in the run's table of evaluations.
    pub(crate) fn new(config: &RunConfig, run_dir: &RunFolder) -> anyhow::Result<Self> {
        let config = config.local.evaluation;
        let played = match config {
            Some(_) => EvaluationRow::all(run_dir)?,
            None => Vec::new(),
        };
        let newest = played.iter().map(|it| it.updates).max().unwrap_or(0);
        Ok(Self { config, newest })
    }

    /// The number of episodes for the checkpoint after `updates`, if it is due. The last one is due unless it was evaluated before.
    pub(crate) fn take_episodes(&mut self, updates: u64, is_last: bool) -> Option<u32> {
        let config = self.config?;
        let step = if is_last { 1 } else { config.every_updates };
        if updates / step <= self.newest / step {
            return None;
        }
        self.newest = updates;
        Some(config.episodes)
    }
}

pub(crate) struct Evaluator {
    schedule: EvaluationSchedule,
    run_dir: RunFolder,
    process: Option<ManagedProcess>,
}

impl Evaluator {
    pub(crate) fn new(config: &RunConfig, run_dir: &RunFolder) -> anyhow::Result<Self> {
        Ok(Self {
            schedule: EvaluationSchedule::new(config, run_dir)?,
            run_dir: run_dir.clone(),
            process: None,
        })
    }

    /// Reports an evaluation that has ended, and begins the next one if a checkpoint is due.
    pub(crate) fn poll(&mut self, screen: &Screen) {
        screen.print_lines(self.take_report());
        if self.process.is_none() {
            self.start_if_due(false, screen);
        }
    }

    /// Evaluates the last checkpoint. Waits for the result up to an hour, or until the run is told to stop.
    pub(crate) fn finish(&mut self, screen: &Screen, shutdown: &Shutdown) {
        let deadline = Instant::now() + LAST_EVALUATION_MAX;
        loop {
            screen.print_lines(self.take_report());
            if self.process.is_none() {
                if !self.start_if_due(true, screen) {
                    return;
                }
                screen.print_line("playing the last checkpoint (skip it with Ctrl-C)");
            }
            if shutdown.wait_timeout(POLL) || Instant::now() > deadline {
                screen.print_line("skipped the last evaluation");
                return;
            }
        }
    }

    /// Begins to evaluate the newest checkpoint if it is due. Returns whether it did.
    fn start_if_due(&mut self, is_last: bool, screen: &Screen) -> bool {
        if self.schedule.config.is_none() {
            return false;
        }
        let Some((updates, _)) = self.run_dir.newest_checkpoint() else {
            return false;
        };
        let Some(episodes) = self.schedule.take_episodes(updates, is_last) else {
            return false;
        };
        let words = format!("evaluate --keep --checkpoint {updates} --episodes {episodes}");
        let mut args: Vec<_> = words.split(' ').map(OsStr::new).collect();
        args.push(self.run_dir.path().as_os_str());
        let logs = self.run_dir.logs();
        match ManagedProcess::start("evaluation", program_command(&args, 1), &logs, screen) {
            Ok(process) => self.process = Some(process),
            Err(e) => screen.print_line(&format!(
                "cannot evaluate the checkpoint after {}: {e:#}",
                count(updates, "update")
            )),
        }
        self.process.is_some()
    }

    /// Describes an evaluation that has ended. A failed evaluation costs the run nothing but a printed line.
    fn take_report(&mut self) -> Option<String> {
        let process = self.process.as_mut()?;
        let is_success = process.exit_status()?.success();
        let report = match EvaluationRow::all(&self.run_dir) {
            _ if !is_success => format!(
                "the run continues without an evaluation: {}",
                process.exit_report()
            ),
            // Meanwhile `driml evaluate --keep` may have added rows of other checkpoints.
            Ok(all) => {
                let row = all.iter().rfind(|it| it.updates == self.schedule.newest);
                row.map(EvaluationRow::describe).unwrap_or_default()
            }
            Err(e) => format!("{e:#}"),
        };
        self.process = None;
        Some(report)
    }
}

#[cfg(test)]
mod tests {
    use std::process::Command;

    use super::*;
    use crate::testing::{config, run_folder};

    #[test]
    fn the_reported_evaluation_is_that_of_the_run_s_own_process() {
        let (_root, folder) = run_folder();
        let every = "local.evaluation={every_updates=100,episodes=4}";
        let config = config("smoke", "chain", "c51", &[every]);
        let mut evaluator = Evaluator::new(&config, &folder).unwrap();
        assert_eq!(evaluator.schedule.take_episodes(200, false), Some(4));
        for updates in [200, 100] {
            let row = EvaluationRow::new(&folder, updates, 4, (1.5, None));
            row.append_to(&folder).unwrap();
        }
        let mut process = ManagedProcess::spawn("evaluation", Command::new("true")).unwrap();
        process.wait_until(Instant::now() + LAST_EVALUATION_MAX, || false);
        evaluator.process = Some(process);
        let report = evaluator.take_report().unwrap();
        let is_own = report.starts_with("evaluated after 200 updates");
        assert!(is_own, "{report}");
    }
}
