//! Plays a run's checkpoints during the run, each in its own process, one at a time.
//! What a checkpoint earned, the process itself writes into the run's folder.

use std::{
    path::Path,
    time::{Duration, Instant},
};

use driml_learner::checkpoint;
use driml_settings::config::EvaluationConfig;

use crate::{
    console::Screen,
    managed_process::{ManagedProcess, Surroundings},
    run_folder::{Evaluated, RunFolder, sweep},
};

/// How long the last evaluation may take once the run is over.
const LAST_MAX: Duration = Duration::from_secs(3600);
/// How often it is looked at then.
const POLL: Duration = Duration::from_millis(100);

/// Plays checkpoints as they appear.
pub(crate) struct Evaluator {
    config: EvaluationConfig,
    run_dir: RunFolder,
    /// Updates of the newest checkpoint that was played or is.
    newest: u64,
    playing: Option<ManagedProcess>,
}

impl Evaluator {
    /// Continues after the checkpoints that the run's folder lists as played.
    pub(crate) fn new(config: EvaluationConfig, run_dir: &RunFolder) -> anyhow::Result<Self> {
        Ok(Self {
            config,
            run_dir: run_dir.clone(),
            newest: Evaluated::newest(run_dir)?,
            playing: None,
        })
    }

    /// Says what an evaluation that has ended found, and begins the next if there is a checkpoint for it.
    pub(crate) fn look(&mut self, screen: &Screen) {
        self.take_result(screen);
        if self.playing.is_none() {
            self.begin(false, screen);
        }
    }

    /// Plays the last checkpoint, and waits for it unless the run is told to stop.
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

    /// Begins to play the newest checkpoint if it is due. Says whether it did.
    fn begin(&mut self, is_last: bool, screen: &Screen) -> bool {
        let all = checkpoint::list(&self.run_dir.checkpoints()).unwrap_or_else(|e| {
            tracing::debug!("looking for a checkpoint to play: {e}");
            Vec::new()
        });
        let is_due = |&updates: &u64| self.config.is_due(updates, self.newest, is_last);
        let Some(updates) = all.last().map(|it| it.0).filter(is_due) else {
            return false;
        };
        self.newest = updates;
        let logs = self.run_dir.logs();
        match self.start(updates, &logs, screen) {
            Ok(process) => self.playing = Some(process),
            Err(e) => screen.line(&format!(
                "the checkpoint after {updates} updates is not played: {e:#}"
            )),
        }
        self.playing.is_some()
    }

    fn start(&self, updates: u64, logs: &Path, screen: &Screen) -> anyhow::Result<ManagedProcess> {
        let args = [
            "evaluate".into(),
            self.run_dir.display().to_string(),
            "--keep".into(),
            "--checkpoint".into(),
            updates.to_string(),
            "--episodes".into(),
            self.config.episodes.to_string(),
        ];
        let surroundings = Surroundings {
            logs,
            screen,
            meeting: None,
        };
        ManagedProcess::start("evaluation", &args, 1, surroundings)
    }

    /// Takes note of an evaluation that has ended. One that failed costs the run nothing but a line.
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

impl Drop for Evaluator {
    fn drop(&mut self) {
        // Which kills it.
        self.playing = None;
        sweep(&self.run_dir);
    }
}
