//! Evaluates a run's checkpoints and keeps the best: `keep` evaluates one in this process, `Evaluator` starts a process for each.
//! `driml evaluate` measures the best on other episodes, as the best of many checkpoints is partly the luckiest.

use std::{
    ffi::OsStr,
    path::Path,
    time::{Duration, Instant},
};

use driml_learner::checkpoint;
use driml_machine::error::Interrupted;
use driml_settings::config::{EvaluationConfig, RunConfig};

use crate::{
    chosen::{Weights, Which, checkpoint_at, config_of},
    console::Screen,
    evaluate::{Levels, Player, Who, levels, until},
    managed_process::ManagedProcess,
    run_folder::{Candidate, Evaluated, RunFolder},
    stats::mean_and_deviation,
};

/// The seed of the episodes on which checkpoints are compared; reports use other seeds.
pub const SELECTION_SEED: u64 = 1 << 32;

/// The evaluation of a checkpoint, and whether the checkpoint is the run's best.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Judged {
    /// The evaluation of the checkpoint.
    pub earned: Evaluated,
    /// Whether the checkpoint was kept.
    pub is_best: bool,
    /// The evaluation of the best checkpoint before this one, over at least as many episodes.
    pub best_before: Option<Evaluated>,
}

/// Plays a checkpoint of a run on the training levels, with averaged weights if it has them. Adds the evaluation to the run's table, and
/// keeps the checkpoint if it earned more than the best before it.
///
/// Both are compared over the same episodes. A best checkpoint that was played for fewer episodes is played again. A checkpoint that is
/// played for fewer episodes than the best does not replace it.
///
/// # Errors
/// A file system error; [`Interrupted`] once `is_stopped` returns true: then nothing is kept.
pub fn keep(
    folder: &RunFolder,
    which: Which,
    episodes: u32,
    is_stopped: &dyn Fn() -> bool,
) -> anyhow::Result<Judged> {
    let path = checkpoint_at(folder, which)?;
    let candidate = Candidate::read(&path)?;
    let play = |path: &Path| -> anyhow::Result<Evaluated> {
        let player = Player::read(config_of(folder)?, path, Weights::default())?;
        let world = levels(&player.config.world, Levels::Train)?;
        let count = episodes as usize;
        let watch = &mut until(is_stopped);
        let returns = player.play_watched(Who::Agent, &world, count, SELECTION_SEED, watch)?;
        if returns.len() < count {
            return Err(Interrupted.into());
        }
        let earned = mean_and_deviation(&returns);
        Ok(Evaluated::at(folder, player.updates, episodes, earned))
    };
    let earned = play(&path)?;
    let mut best_before = Evaluated::best(folder)?;
    let is_short = |it: &Evaluated| it.updates != earned.updates && it.episodes < episodes;
    if best_before.is_some_and(|it| is_short(&it))
        && let Some((_, best)) = checkpoint::list(&folder.best())?.pop()
    {
        let again = play(&best)?;
        again.add(folder)?;
        best_before = Some(again);
    }
    let is_best = candidate.judge(folder, &earned)?;
    Ok(Judged {
        earned,
        is_best,
        best_before,
    })
}

const LAST_MAX: Duration = Duration::from_secs(3600);
const POLL: Duration = Duration::from_millis(100);

/// Decides which checkpoints of a run are evaluated.
pub(crate) struct Due {
    config: Option<EvaluationConfig>,
    /// Updates of the newest checkpoint that was evaluated or is being evaluated.
    newest: u64,
}

impl Due {
    /// The checkpoints that are newer than those in the run's table of evaluations.
    pub(crate) fn new(config: &RunConfig, run_dir: &RunFolder) -> anyhow::Result<Self> {
        let config = config.local.evaluation;
        let played = match config {
            Some(_) => Evaluated::all(run_dir)?,
            None => Vec::new(),
        };
        let newest = played.iter().map(|it| it.updates).max().unwrap_or(0);
        Ok(Self { config, newest })
    }

    /// The number of episodes for the checkpoint after `updates`, if it is due. The last one is due unless it was evaluated before.
    pub(crate) fn take(&mut self, updates: u64, is_last: bool) -> Option<u32> {
        let config = self.config?;
        let step = if is_last { 1 } else { config.every_updates };
        if updates / step <= self.newest / step {
            return None;
        }
        self.newest = updates;
        Some(config.episodes)
    }
}

/// Evaluates the checkpoints that are due, one at a time.
pub(crate) struct Evaluator {
    due: Due,
    run_dir: RunFolder,
    playing: Option<ManagedProcess>,
}

impl Evaluator {
    pub(crate) fn new(config: &RunConfig, run_dir: &RunFolder) -> anyhow::Result<Self> {
        Ok(Self {
            due: Due::new(config, run_dir)?,
            run_dir: run_dir.clone(),
            playing: None,
        })
    }

    /// Reports an evaluation that has ended, and begins the next one if a checkpoint is due.
    pub(crate) fn look(&mut self, screen: &Screen) {
        self.take_result(screen);
        if self.playing.is_none() {
            self.begin(false, screen);
        }
    }

    /// Evaluates the last checkpoint. Waits for the result up to an hour, or until the run is told to stop.
    pub(crate) fn finish(&mut self, screen: &Screen, abort: &impl Fn() -> bool) {
        let deadline = Instant::now() + LAST_MAX;
        let mut last = false;
        loop {
            self.take_result(screen);
            if self.playing.is_none() {
                if last || !self.begin(true, screen) {
                    return;
                }
                last = true;
                screen.line("playing the last checkpoint (skip it with Ctrl-C)");
            }
            if abort() || Instant::now() > deadline {
                screen.line("the last evaluation was left out");
                return;
            }
            std::thread::sleep(POLL);
        }
    }

    /// Begins to evaluate the newest checkpoint if it is due. Returns whether it did.
    fn begin(&mut self, is_last: bool, screen: &Screen) -> bool {
        if self.due.config.is_none() {
            return false;
        }
        let all = checkpoint::list(&self.run_dir.checkpoints()).unwrap_or_else(|e| {
            tracing::debug!("looking for a checkpoint to play: {e}");
            Vec::new()
        });
        let newest = all.last().map(|it| it.0);
        let due = newest.and_then(|it| Some((it, self.due.take(it, is_last)?)));
        let Some((updates, episodes)) = due else {
            return false;
        };
        let words = format!("evaluate --keep --checkpoint {updates} --episodes {episodes}");
        let mut args: Vec<_> = words.split(' ').map(OsStr::new).collect();
        args.push(self.run_dir.path().as_os_str());
        let logs = self.run_dir.logs();
        match ManagedProcess::start("evaluation", &args, 1, &logs, screen, None) {
            Ok(process) => self.playing = Some(process),
            Err(e) => screen.line(&format!(
                "the checkpoint after {updates} updates is not played: {e:#}"
            )),
        }
        self.playing.is_some()
    }

    /// Reports an evaluation that has ended. A failed evaluation costs the run nothing but a printed line.
    fn take_result(&mut self, screen: &Screen) {
        let Some(process) = &mut self.playing else {
            return;
        };
        if process.end().is_none() {
            return;
        }
        process.wait_until(Instant::now(), || false);
        let failed = process.end().is_some_and(|status| !status.success());
        let said = match (failed, Evaluated::all(&self.run_dir)) {
            (true, _) => format!(
                "the run continues without an evaluation: {}",
                process.exit_report()
            ),
            (false, Ok(all)) => all.last().map(Evaluated::describe).unwrap_or_default(),
            (false, Err(e)) => format!("{e:#}"),
        };
        screen.line(&said);
        self.playing = None;
    }
}
