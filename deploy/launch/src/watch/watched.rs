//! A run that is watched, as far as it was heard: what is shown of it, what is recorded, and when it is over.
//! It asks nobody.

use std::time::{Duration, Instant};

use anyhow::bail;
use driml_machine::units::duration;
use driml_protocol::{LearnerStatus, ReplayStatus, Waiting};
use driml_settings::config::RunConfig;

use super::{
    folder::{self, Found},
    outputs::Outputs,
};
use crate::{
    console::{self, Screen},
    live_view::{Display, TEMPLATE, recovery, silence},
    run_folder::{Episodes, MeanReturn, Outcome, ResumePoint, RunRecorder, Summary},
    status::{Connection, Snapshot, not_joined, silent_actors},
};

/// How long replay servers that said that all is sampled may be silent before they have ended.
const FAREWELL_MAX: Duration = Duration::from_secs(5);
/// Seconds for which a run goes on at the most, as far as its clock is shown: ten years.
const UP_MAX: f64 = 315_360_000.0;
/// Actors of which nothing is heard that are named.
const SILENT_NAMED: usize = 4;

/// A run that is watched.
pub(super) struct Watched {
    config: RunConfig,
    after_updates: u64,
    screen: Screen,
    display: Display,
    recorder: Option<RunRecorder>,
    /// When the run began, as far as is known.
    began: Instant,
    /// Since when replay servers and learner have been silent.
    replay_heard: Instant,
    learner_heard: Instant,
    /// The last answers.
    shards: Vec<ReplayStatus>,
    replay: ReplayStatus,
    learner: LearnerStatus,
}

impl Watched {
    /// A run whose first answer is `snapshot`.
    ///
    /// # Errors
    /// A folder that cannot be written to.
    pub(super) fn new(
        connection: &Connection,
        snapshot: &Snapshot,
        outputs: &Outputs,
    ) -> anyhow::Result<Self> {
        let config = connection.config.clone();
        let after_updates = connection.after_updates.unwrap_or_default();
        let servers = snapshot.servers.iter();
        let up_s = servers
            .filter_map(|it| Some(it.parts.as_ref()?.up_s))
            .fold(0.0, f64::max);
        let learner = snapshot.learner.clone().unwrap_or_default();
        let found = Found {
            config: &config,
            after_updates,
            replay: &snapshot.replay,
            learner: &learner,
            up_s,
        };
        let recorder = match &outputs.run_dir {
            Some(folder) => {
                let mut recorder = folder::record(folder, &found)?;
                if outputs.tensorboard {
                    recorder.write_events(folder)?;
                }
                Some(recorder)
            }
            None => None,
        };
        let screen = Screen::new(config.frames(), TEMPLATE);
        let now = ResumePoint {
            updates: learner.updates.max(after_updates),
            rows: snapshot.replay.rows_sampled,
            frames: snapshot.replay.transitions_inserted,
            replay_is_kept: true,
        };
        let start = Instant::now();
        let up = Duration::try_from_secs_f64(up_s.min(UP_MAX)).unwrap_or_default();
        if let Some(bar) = screen.bar() {
            // The view's clock is the run's. All copies of a bar are one.
            drop(bar.clone().with_elapsed(up));
        }
        let display = Display::new(screen.clone(), config.frames(), config.updates(), now);
        let began = start.checked_sub(up).unwrap_or(start);
        Ok(Self {
            display: display.since(began),
            config,
            after_updates,
            screen,
            recorder,
            began,
            replay_heard: start,
            learner_heard: start,
            shards: Vec::new(),
            replay: ReplayStatus::default(),
            learner,
        })
    }

    /// Takes an answer: shows and records it. True if the run is over.
    ///
    /// # Errors
    /// Nobody of the run is there any more, or another one is.
    pub(super) fn take(
        &mut self,
        snapshot: &Snapshot,
        connection: &mut Connection,
    ) -> anyhow::Result<bool> {
        if let Some(other) = snapshot.servers.iter().find(|it| it.is_another_run) {
            bail!(
                "a run with other settings has taken the place of this one on {}: watch it anew, with another --run-dir",
                other.endpoint
            );
        }
        let answers = snapshot.servers.iter();
        let shards: Option<Vec<_>> = answers.map(|it| it.replay.clone()).collect();
        let answered = shards.is_some();
        if let Some(shards) = shards {
            (self.shards, self.replay) = (shards, snapshot.replay.clone());
            self.replay_heard = Instant::now();
        }
        if snapshot.recovering().next().is_some() {
            // It is there, and nobody can be asked through it.
            (self.replay_heard, self.learner_heard) = (Instant::now(), Instant::now());
        }
        if let Some(learner) = &snapshot.learner {
            self.learner = learner.clone();
            self.learner_heard = Instant::now();
        }
        // Until the learner of a resumed run has answered, too.
        self.learner.updates = self.learner.updates.max(self.after_updates);
        if answered {
            self.record(connection);
        }
        let notes = self.notes(snapshot);
        let episodes = self.episodes();
        self.display
            .show(&self.replay, &self.learner, episodes, &notes);
        self.is_over()
    }

    /// Writes a line above the view.
    pub(super) fn say(&self, line: &str) {
        self.screen.line(line);
    }

    fn record(&mut self, connection: &mut Connection) {
        let Some(recorder) = &mut self.recorder else {
            return;
        };
        let ended = connection.fetch_episodes(&self.shards);
        let mut said = recorder.hear_episodes(&self.shards, &ended);
        said.extend(recorder.record(&self.shards, &self.learner, &[]));
        said.iter().for_each(|line| self.screen.line(line));
    }

    /// Who does not answer, and for how long.
    fn notes(&self, snapshot: &Snapshot) -> Vec<String> {
        let recovering = snapshot.recovering();
        let recovering: Vec<_> = recovering
            .map(|(server, progress)| recovery(&server.endpoint, progress))
            .collect();
        if !recovering.is_empty() {
            return recovering;
        }
        let replay = silence("replay server", self.replay_heard);
        // While it is silent nobody else can be heard.
        if let Some(replay) = replay {
            return vec![replay];
        }
        let (no_learner, no_actor) = not_joined(snapshot);
        let learner = match self.learner.finished {
            true => None,
            false if no_learner => Some("no learner has joined yet".to_owned()),
            false => silence("learner", self.learner_heard),
        };
        let actor = no_actor.then(|| "no actor has joined yet".to_owned());
        let mut notes: Vec<_> = learner.into_iter().chain(actor).collect();
        notes.extend(silent_actors(snapshot, SILENT_NAMED));
        notes
    }

    /// Whether all frames of the run are in.
    pub(super) const fn all_frames_are_in(&self) -> bool {
        self.replay.finished
    }

    fn is_over(&mut self) -> anyhow::Result<bool> {
        if self.replay.finished && self.learner.finished {
            return Ok(true);
        }
        let silent = self.replay_heard.elapsed();
        // They end by themselves once the learner has saved. Its last word may have gone to somebody else who asked, or it was ended
        // by its launcher before it was asked again.
        if silent > FAREWELL_MAX && self.replay.waiting == Waiting::Finished {
            self.learn_all_that_was_served();
            return Ok(true);
        }
        let silent_max = Duration::from_millis(self.config.learner.unreachable_max_ms);
        if silent > silent_max {
            bail!(
                "the replay server has not answered for {}, after which the learner gives it up too: the run has ended, or is cut off",
                duration(silent)
            );
        }
        Ok(false)
    }

    /// Counts the updates of which the learner did not tell any more.
    fn learn_all_that_was_served(&mut self) {
        let updates = self.replay.rows_sampled / u64::from(self.config.learner.batch_size);
        if self.learner.updates >= updates {
            return;
        }
        self.screen.line(
            "the learner's last word was not heard: its updates are those whose batches were served, its losses and weights those before",
        );
        self.learner.updates = updates;
        if let Some(recorder) = &mut self.recorder {
            let said = recorder.record(&self.shards, &self.learner, &[]);
            said.iter().for_each(|line| self.screen.line(line));
        }
    }

    fn episodes(&self) -> Episodes {
        let returns = &self.replay.returns;
        match &self.recorder {
            Some(recorder) => recorder.episodes(&self.replay),
            None => Episodes {
                count: self.replay.episodes,
                mean_return: returns.mean().map(|mean| MeanReturn {
                    mean,
                    of: returns.newest.len(),
                }),
            },
        }
    }

    /// Takes the view away, says what could not be recorded, and gives the summary of a run that ended so.
    pub(super) fn conclude(&mut self, outcome: Outcome) -> Summary {
        self.screen.clear();
        let run = &self.config.run;
        let summary = match &self.recorder {
            Some(recorder) => {
                let missing = recorder.missing();
                missing.iter().for_each(|line| console::line(line));
                recorder.summarise(outcome, run, &self.replay, &self.learner)
            }
            None => {
                let seconds = self.began.elapsed().as_secs_f64();
                let episodes = self.episodes();
                Summary::of(outcome, run, &self.replay, &self.learner, episodes, seconds)
            }
        };
        Summary {
            resumed_after_updates: self.after_updates,
            ..summary
        }
    }
}
