//! What is written into the run folder while a run goes on: settings, metrics, episodes, events on request, and the summary at its end.
//! It reads no status from anywhere: its caller hands them over.

use std::{
    fs::{self, File},
    time::Instant,
};

use anyhow::Context;
use driml_actor::Schedule;
use driml_protocol::{EpisodesReply, LearnerStatus, ReplayStatus, RunSpec};
use driml_settings::config::RunConfig;

use super::{
    columns::Columns,
    episodes::{Episodes, TrainingEpisodes},
    events::Events,
    folder::RunFolder,
    growing_csv::GrowingCsv,
    metrics::{Moment, header, rows_up_to, seconds_of},
    resume_point::ResumePoint,
    summary::{Outcome, Summary},
};
use crate::rates::Rates;

/// What a recorder knows of a run before it begins.
#[derive(Clone, Debug, Default)]
pub struct Recorded {
    /// The settings, as `config.toml` has them.
    pub config_toml: String,
    /// The names of the agent's auxiliary losses.
    pub losses: &'static [&'static str],
    /// The processes whose memory is recorded.
    pub processes: Vec<String>,
    /// How likely all actors act at random; none where they differ in that.
    pub epsilon: Option<Schedule>,
}

impl Recorded {
    /// Of a run with these settings and processes.
    pub(crate) fn of(config: &RunConfig, processes: Vec<String>) -> Self {
        let is_common = config.actor.epsilon_ladder.is_none();
        Self {
            config_toml: config.to_toml(),
            losses: config.learner.update.objective.losses(),
            processes,
            // Without a ladder it is every actor's.
            epsilon: Schedule::new(&config.actor, 0).ok().filter(|_| is_common),
        }
    }
}

/// Writes a run folder.
#[derive(Debug)]
pub struct RunRecorder {
    /// No other launcher writes to the folder while this is held.
    _lock: File,
    resume_point: ResumePoint,
    /// Seconds, frames and episodes in the last row before the run was resumed.
    seconds_before: f64,
    frames_before: u64,
    episodes_before: u64,
    /// Mean and standard deviation of k up to there.
    k_before: Option<(f64, f64)>,
    metrics: GrowingCsv,
    header: Vec<String>,
    events: Option<Events>,
    episodes: TrainingEpisodes,
    /// The next episodes that are heard had ended before.
    is_late: bool,
    run: Recorded,
    rss_max: Vec<Option<f64>>,
    started: Instant,
    rates: Rates,
}

impl RunRecorder {
    /// Makes the folder and writes the settings; the clock starts.
    ///
    /// # Errors
    /// A folder in which something lies, or a file system that refuses.
    pub fn create(folder: &RunFolder, run: Recorded) -> anyhow::Result<Self> {
        folder.check_free()?;
        fs::create_dir_all(folder.path())
            .with_context(|| format!("making the run folder {}", folder.display()))?;
        let lock = folder.lock()?;
        folder.write_config(&run.config_toml)?;
        let rows = Columns {
            header: header(run.losses, &run.processes),
            rows: Vec::new(),
        };
        let episodes = TrainingEpisodes::create(folder)?;
        Self::begin(folder, run, lock, rows, episodes, ResumePoint::default())
    }

    /// Goes on from `resume_point` to `frames_max` frames in the folder of an interrupted run: the rows of metrics up
    /// to there stay.
    ///
    /// # Errors
    /// A run that is still going on, metrics of other columns, or a file system that refuses.
    pub(crate) fn go_on(
        folder: &RunFolder,
        run: Recorded,
        resume_point: ResumePoint,
        frames_max: u64,
    ) -> anyhow::Result<Self> {
        let lock = folder.lock()?;
        let head = header(run.losses, &run.processes);
        let seconds = seconds_of(folder);
        let rows = rows_up_to(&folder.metrics(), head, resume_point, frames_max)?;
        let is_known = resume_point.replay_is_kept;
        let episodes = TrainingEpisodes::go_on(folder, resume_point.frames, is_known)?;
        Summary::remove(folder)?;
        folder.write_config(&run.config_toml)?;
        let mut this = Self::begin(folder, run, lock, rows, episodes, resume_point)?;
        this.count_seconds(seconds);
        Ok(this)
    }

    fn begin(
        folder: &RunFolder,
        run: Recorded,
        lock: File,
        rows: Columns,
        episodes: TrainingEpisodes,
        resume_point: ResumePoint,
    ) -> anyhow::Result<Self> {
        // A replay that was kept knows of all the run's episodes and k.
        let is_kept = resume_point.replay_is_kept;
        let before = |column| rows.last(column).filter(|_| !is_kept);
        let episodes_before = match is_kept {
            true => 0,
            false => rows.last("episodes").unwrap_or(0).max(episodes.count()),
        };
        let mut this = Self {
            _lock: lock,
            resume_point,
            seconds_before: rows.last("seconds").unwrap_or(0.0),
            frames_before: resume_point.frames,
            episodes_before,
            k_before: before("mean_k").zip(before("sd_k")),
            metrics: GrowingCsv::create(&folder.metrics(), &rows.header, &rows.rows)?,
            header: rows.header,
            events: None,
            episodes,
            is_late: false,
            rss_max: vec![None; run.processes.len()],
            run,
            started: Instant::now(),
            rates: Rates::default(),
        };
        this.rates
            .add(this.started, resume_point.frames, resume_point.updates);
        Ok(this)
    }

    /// Writes TensorBoard's events from now on, too.
    ///
    /// # Errors
    /// A file system that refuses.
    pub(crate) fn write_events(&mut self, folder: &RunFolder) -> anyhow::Result<()> {
        let kept = (self.resume_point.updates > 0).then_some(self.frames_before);
        self.events = Some(Events::create(folder, self.header.clone(), kept)?);
        Ok(())
    }

    /// The run has been going on for at least so many seconds, in which nobody recorded it.
    pub(crate) fn count_seconds_from(&mut self, seconds: f64) {
        self.is_late = true;
        self.count_seconds(seconds);
    }

    fn count_seconds(&mut self, seconds: f64) {
        self.seconds_before = self.seconds_before.max(seconds);
    }

    /// Mean and standard deviation of k over all rows of the run, before it was resumed too.
    fn k(&self, replay: &ReplayStatus) -> Option<(f64, f64)> {
        let since = replay.mean_k().zip(replay.sd_k());
        let (Some(before), Some(since)) = (self.k_before, since) else {
            return since.or(self.k_before);
        };
        let rows = replay.rows_sampled.max(self.resume_point.rows).max(1);
        let share = self.resume_point.rows as f64 / rows as f64;
        let mixed = |before: f64, since: f64| share * before + (1.0 - share) * since;
        let square = |(mean, sd): (f64, f64)| mean * mean + sd * sd;
        let mean = mixed(before.0, since.0);
        let variance = mixed(square(before), square(since)) - mean * mean;
        Some((mean, variance.max(0.0).sqrt()))
    }

    fn seconds(&self) -> f64 {
        self.seconds_before + self.started.elapsed().as_secs_f64()
    }

    /// Takes the episodes that `ended` since the last time, each answer with its shard; `shards` are the replay servers' own accounts.
    /// Warnings are returned as by [`Self::record`], which is to follow.
    pub fn hear_episodes(
        &mut self,
        shards: &[ReplayStatus],
        ended: &[(usize, EpisodesReply)],
    ) -> Vec<String> {
        let seconds = (!std::mem::take(&mut self.is_late)).then(|| self.seconds());
        self.episodes.hear(shards, ended, seconds)
    }

    /// Takes the state of the run: adds a row of metrics, in a resumed run once it is further than its last row.
    /// `shards` are the replay servers' own accounts; `rss_mib` is in the order of the processes given at
    /// the start, none for one that ended.
    ///
    /// A disk that is full does not end the run: a warning is returned the first time, and [`Self::missing`] says
    /// at the end what was lost.
    pub fn record(
        &mut self,
        shards: &[ReplayStatus],
        learner: &LearnerStatus,
        rss_mib: &[Option<f64>],
    ) -> Vec<String> {
        let replay = &ReplayStatus::merged(shards);
        self.rates
            .add(Instant::now(), replay.transitions_inserted, learner.updates);
        for (max, now) in self.rss_max.iter_mut().zip(rss_mib) {
            *max = now.map_or(*max, |now| Some(max.map_or(now, |max: f64| max.max(now))));
        }
        let (frames, updates) = (replay.transitions_inserted, learner.updates);
        let resumed = self.resume_point.updates > 0;
        if resumed && (updates <= self.resume_point.updates || frames < self.frames_before) {
            return Vec::new();
        }
        let processes = 0..self.run.processes.len();
        let moment = Moment {
            seconds: self.seconds(),
            rates: self.rates.per_second(),
            episodes: self.episodes(replay),
            k: self.k(replay),
            replay,
            learner,
            epsilon: self.run.epsilon.map(|it| it.epsilon(frames)),
            losses: self.run.losses,
            rss_mib: processes
                .map(|i| rss_mib.get(i).copied().flatten())
                .collect(),
        };
        let row = moment.row();
        let events = self.events.as_mut();
        let drawn = events.and_then(|events| events.add(&row, replay, learner.finished));
        let written = self.metrics.add(row);
        written.into_iter().chain(drawn).collect()
    }

    /// What to say about rows that could not be written up to now.
    pub fn missing(&self) -> Vec<String> {
        let events = self.events.as_ref().and_then(Events::missing);
        let mut missing = self.episodes.missing();
        missing.extend([self.metrics.missing(), events].into_iter().flatten());
        missing
    }

    /// The whole run's episodes.
    pub fn episodes(&self, replay: &ReplayStatus) -> Episodes {
        Episodes {
            count: self.episodes_before + replay.episodes,
            mean_return: self.episodes.mean(),
        }
    }

    /// What there is to say of the run, which ended so.
    pub fn summarise(
        &self,
        outcome: Outcome,
        run: &RunSpec,
        replay: &ReplayStatus,
        learner: &LearnerStatus,
    ) -> Summary {
        let wall_seconds = self.seconds();
        // A resumed run that did not get anywhere still has what was done before.
        let frames = replay.transitions_inserted.max(self.resume_point.frames);
        let updates = learner.updates.max(self.resume_point.updates);
        let rss = self.run.processes.iter().zip(&self.rss_max);
        let of_whole_run = Summary::of(
            outcome,
            run,
            replay,
            learner,
            self.episodes(replay),
            wall_seconds,
        );
        Summary {
            resumed_after_updates: self.resume_point.updates,
            frames,
            updates,
            frames_per_second: frames as f64 / wall_seconds,
            updates_per_second: updates as f64 / wall_seconds,
            mean_k: self.k(replay).map(|(mean, _)| mean),
            rss_mib_max: rss
                .map(|(name, mib)| (name.clone(), mib.map(f64::round).into()))
                .collect(),
            ..of_whole_run
        }
    }
}

#[cfg(test)]
#[path = "recorder_tests.rs"]
mod tests;
