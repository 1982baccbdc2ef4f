//! A run that is watched, as far as its answers tell: what is shown, what is recorded, and when the run is over.
//! This module requests nothing but the episodes that it records.

use std::time::{Duration, Instant};

use anyhow::bail;
use driml_machine::{error::usage, units::duration};
use driml_protocol::{RunSpec, Waiting};
use driml_settings::config::RunConfig;

use crate::{
    checkpoint_choice::read_config,
    console,
    launcher::process_names,
    run_folder::{BeforeReplay, Outcome, ResumePoint, RunFolder, RunRecorder, Summary, Table},
    run_view::{RunView, updates_served},
    view::{Display, Poller},
};

/// How long replay servers may be silent before they count as ended, once they have reported that everything is sampled, or nothing listens
/// in their place.
const EXIT_SILENCE_MAX: Duration = Duration::from_secs(5);
/// Longest time of a run that is shown, seconds: ten years.
const UPTIME_MAX_S: f64 = 315_360_000.0;

pub(super) struct WatchedRun {
    /// Shows the run from its beginning, as far as that is known.
    pub(super) display: Display,
    recorder: Option<RunRecorder>,
    /// The last answer of each server: its uptime in seconds, and whether its replay is kept on disk.
    answers: Vec<Option<(f64, bool)>>,
}

impl WatchedRun {
    /// Starts to watch a run that was polled once, recorded in `folder` if there is one, with TensorBoard's `events` on request.
    pub(super) fn new(
        poller: &Poller,
        folder: Option<&RunFolder>,
        events: bool,
    ) -> anyhow::Result<Self> {
        let (config, view) = (&poller.config, &poller.view);
        let recorder = folder.map(|it| open_recorder(it, config, view, events));
        let recorder = recorder.transpose()?;
        let up_s = view.uptime_s().unwrap_or(0.0).min(UPTIME_MAX_S);
        let up = Duration::try_from_secs_f64(up_s).unwrap_or_default();
        let now = Instant::now();
        let began = now.checked_sub(up).unwrap_or(now);
        let display = Display::new(poller.config.frames(), began);
        if let Some(bar) = display.screen.bar() {
            // The bar's clock shows the time of the run. All clones of a bar are the same bar.
            drop(bar.clone().with_elapsed(up));
        }
        Ok(Self {
            display,
            recorder,
            answers: vec![None; view.servers.len()],
        })
    }

    /// Shows and records the poller's last answers. Returns true if the run is over.
    pub(super) fn show_and_record(&mut self, poller: &mut Poller) -> anyhow::Result<bool> {
        if let Some(other) = poller.view.servers.iter().find(|it| it.is_another_run) {
            bail!(
                "{} now serves a run with other settings: start `driml watch` again, with another --run-dir",
                other.endpoint
            );
        }
        let answers = poller.view.servers.iter().map(|it| {
            let status = it.processes.as_ref()?;
            Some((status.up_s, status.log.is_some()))
        });
        let begun_anew = find_begun_anew(&mut self.answers, answers);
        // Its rows would contradict those before.
        if let Some(number) = begun_anew.filter(|_| self.recorder.is_some()) {
            bail!(
                "{} was started again with an empty replay: start `driml watch` again",
                poller.view.servers[number].endpoint
            );
        }
        let recorder = self.recorder.as_mut();
        if let Some(recorder) = recorder.filter(|_| poller.view.servers_answered()) {
            let fetch = |shard, since| poller.fetch_episodes(shard, since, false);
            let mut warnings = recorder.record_episodes(&poller.view, fetch);
            warnings.extend(recorder.record(&mut poller.view, &[]));
            self.display.screen.print_lines(warnings);
        }
        self.display.show(&poller.view);
        Ok(self.is_over(poller))
    }

    fn is_over(&mut self, poller: &mut Poller) -> bool {
        let view = &poller.view;
        if view.is_all_learned() {
            return true;
        }
        // The servers exit once the learner has saved. Another client may have received the learner's last answer, or the launcher may
        // have stopped the learner before it was polled again.
        let is_reported = view.replay.learner_finished && !view.is_learner_answering;
        let has_exited = is_reported || view.replay_silence.length() > EXIT_SILENCE_MAX;
        let is_over = has_exited && view.replay.waiting == Waiting::Finished;
        if is_over {
            self.count_served_updates(poller);
        }
        is_over
    }

    /// Fails if a server has exited whose replay was in memory, as the run cannot continue without it, or if the servers have been silent
    /// for as long as the run's processes wait for them.
    pub(super) fn check_continues(&self, poller: &Poller) -> anyhow::Result<()> {
        let (view, silent) = (&poller.view, poller.view.replay_silence.length());
        let mut servers = view.servers.iter().zip(&self.answers);
        let lost = servers.find(|(it, last)| it.is_gone && matches!(last, Some((_, false))));
        if let Some((server, _)) = lost.filter(|_| silent > EXIT_SILENCE_MAX) {
            bail!(
                "the replay server on {} has exited, and its replay was in memory: the run has ended, and the output of its processes tells how",
                server.endpoint
            );
        }
        if silent > Duration::from_millis(poller.config.learner.unreachable_max_ms) {
            bail!(
                "the replay server has not answered for {}: the run has ended, or the network is interrupted; once it answers, start `driml watch` again",
                duration(silent)
            );
        }
        Ok(())
    }

    fn count_served_updates(&mut self, poller: &mut Poller) {
        let updates = updates_served(&poller.config, poller.view.replay.rows_sampled);
        if poller.view.learner.updates >= updates {
            return;
        }
        self.display.screen.print_line(
            "the learner's last status is missing: updates are counted by the batches served, losses and weights are older",
        );
        poller.view.learner.updates = updates;
        if let Some(recorder) = &mut self.recorder {
            let warnings = recorder.record(&mut poller.view, &[]);
            self.display.screen.print_lines(warnings);
        }
    }

    /// Removes the live lines, prints what could not be recorded, and returns the summary of a run that ended with `outcome`.
    pub(super) fn finish(&mut self, view: &mut RunView, outcome: Outcome) -> Summary {
        self.display.screen.clear();
        let Some(recorder) = &self.recorder else {
            // The servers' clocks do not count the time before a resume or a restart, and their frames do.
            return Summary::new(outcome, view, f64::NAN, ResumePoint::default());
        };
        let missing = recorder.loss_messages();
        missing.iter().for_each(|line| console::eprintln(line));
        recorder.summarise(outcome, view)
    }
}

/// Returns the number of a server that was started again without its replay, so that its counts begin anew. The answers, the last and
/// the new ones, are those of [`WatchedRun`]; `None` for a server that did not answer.
fn find_begun_anew(
    last: &mut [Option<(f64, bool)>],
    answers: impl Iterator<Item = Option<(f64, bool)>>,
) -> Option<usize> {
    let mut servers = last.iter_mut().zip(answers);
    servers.position(|(last, answer)| {
        let Some((up_s, is_kept)) = answer else {
            return false;
        };
        let before = last.replace((up_s, is_kept));
        before.is_some_and(|(before_s, _)| up_s < before_s) && !is_kept
    })
}

fn open_recorder(
    folder: &RunFolder,
    config: &RunConfig,
    view: &RunView,
    events: bool,
) -> anyhow::Result<RunRecorder> {
    let mut resumed = None;
    // A learner may have just begun in this folder.
    if folder.config().exists() || folder.checkpoints().is_dir() {
        check_same_run(folder, config)?;
        resumed = Some(resume_point(folder, view)?);
        if folder.is_locked() {
            bail!(usage!(
                "{} is written by `driml train` or by another `driml watch`: watch without --run-dir, or choose another folder",
                folder.display()
            ));
        }
    }
    let mut recorder = RunRecorder::open(folder, config, process_names(config), resumed, events)?;
    if resumed.is_none() {
        let before_replay = BeforeReplay {
            after_updates: view.after_updates.unwrap_or(0),
            ..BeforeReplay::default()
        };
        before_replay.write(folder)?;
    }
    recorder.raise_seconds_before(view.uptime_s().unwrap_or(0.0));
    Ok(recorder)
}

fn check_same_run(folder: &RunFolder, config: &RunConfig) -> anyhow::Result<()> {
    let recorded = match folder.config().exists() {
        true => read_config(folder)?.run,
        false => return Ok(()),
    };
    if recorded.hash() == config.run.hash() {
        return Ok(());
    }
    let name = |it: &RunSpec| format!("{} with {}, seed {}", it.world, it.agent, it.seed);
    bail!(usage!(
        "{} holds another run ({}) than the one that is watched ({}): choose another --run-dir",
        folder.display(),
        name(&recorded),
        name(&config.run)
    ))
}

/// The point up to which the existing rows stay.
fn resume_point(folder: &RunFolder, view: &RunView) -> anyhow::Result<ResumePoint> {
    let rows = Table::read(&folder.metrics())?;
    let last = |name| rows.last::<u64>(name).unwrap_or(0);
    let (frames, updates) = (last("frames"), last("updates"));
    let now = view.replay.transitions_inserted;
    let after_updates = view.after_updates.unwrap_or(0);
    if after_updates == 0 && frames > now {
        bail!(usage!(
            "{} holds rows up to frame {frames}, and the watched run is at frame {now}: it was restarted; choose another --run-dir",
            folder.display()
        ));
    }
    Ok(ResumePoint {
        // A resumed run repeats the updates since its checkpoint.
        updates: match after_updates {
            0 => updates,
            _ => updates.min(view.learner.updates),
        },
        rows: view.replay.rows_sampled,
        frames: now,
        replay_is_kept: after_updates == BeforeReplay::read(folder)?.after_updates,
        after_updates,
        frames_max: u64::MAX,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_server_that_was_started_again_without_its_replay_is_found() {
        for (is_kept, found) in [(false, Some(1)), (true, None)] {
            let mut last = [None; 2];
            let mut find = |up_s: [Option<f64>; 2]| {
                let answers = up_s.into_iter().map(|it| Some((it?, is_kept)));
                find_begun_anew(&mut last, answers)
            };
            // The second server does not answer for a while, and is then another process.
            for up_s in [[Some(2.0), Some(3.0)], [Some(4.0), None]] {
                assert_eq!(find(up_s), None, "{up_s:?}");
            }
            assert_eq!(find([Some(6.0), Some(1.0)]), found);
            assert_eq!(find([Some(8.0), Some(3.0)]), None);
        }
    }
}
