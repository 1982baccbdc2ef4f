//! What is written into the run folder while a run goes on: settings, metrics, returns, events on request, and the summary at its end.
//! It reads no status from anywhere: its caller hands them over.

use std::{
    fs::{self, File},
    time::Instant,
};

use anyhow::Context;
use driml_protocol::{LearnerStatus, ReplayStatus, RunSpec};

use super::{
    columns::Columns,
    events::Events,
    folder::RunFolder,
    growing_csv::GrowingCsv,
    metrics::{Moment, header, rows_up_to},
    resume_point::ResumePoint,
    returns::{Episodes, TrainingReturns},
    summary::{Outcome, Summary},
};
use crate::rates::Rates;

const fn none(header: Vec<String>) -> Columns {
    Columns {
        header,
        rows: Vec::new(),
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
    returns: TrainingReturns,
    losses: &'static [&'static str],
    processes: Vec<String>,
    rss_max: Vec<Option<f64>>,
    started: Instant,
    rates: Rates,
}

impl RunRecorder {
    /// Makes the folder and writes the settings; the clock starts. `losses` are the agent's auxiliary losses,
    /// `processes` those whose memory is recorded.
    ///
    /// # Errors
    /// A folder in which something lies, or a file system that refuses.
    pub fn create(
        folder: &RunFolder,
        config_toml: &str,
        losses: &'static [&'static str],
        processes: &[String],
    ) -> anyhow::Result<Self> {
        folder.check_free()?;
        fs::create_dir_all(folder.path())
            .with_context(|| format!("making the run folder {}", folder.display()))?;
        let lock = folder.lock()?;
        folder.write_config(config_toml)?;
        let rows = none(header(losses, processes));
        let returns = TrainingReturns::create(folder)?;
        Self::begin(
            folder,
            losses,
            processes,
            lock,
            rows,
            returns,
            ResumePoint::default(),
        )
    }

    /// Goes on from `resume_point` to `frames_max` frames in the folder of an interrupted run: the rows of metrics up
    /// to there stay.
    ///
    /// # Errors
    /// A run that is still going on, metrics of other columns, or a file system that refuses.
    pub(crate) fn go_on(
        folder: &RunFolder,
        config_toml: &str,
        losses: &'static [&'static str],
        processes: &[String],
        resume_point: ResumePoint,
        frames_max: u64,
    ) -> anyhow::Result<Self> {
        let lock = folder.lock()?;
        let head = header(losses, processes);
        let rows = match resume_point.updates {
            0 => none(head),
            _ => rows_up_to(&folder.metrics(), head, resume_point, frames_max)?,
        };
        let is_known = resume_point.replay_is_kept;
        let returns = TrainingReturns::go_on(folder, rows.last("frames").unwrap_or(0), is_known)?;
        Summary::remove(folder)?;
        folder.write_config(config_toml)?;
        Self::begin(folder, losses, processes, lock, rows, returns, resume_point)
    }

    fn begin(
        folder: &RunFolder,
        losses: &'static [&'static str],
        processes: &[String],
        lock: File,
        rows: Columns,
        returns: TrainingReturns,
        resume_point: ResumePoint,
    ) -> anyhow::Result<Self> {
        // A replay that was kept knows of all the run's episodes and k.
        let before = |column| match resume_point.replay_is_kept {
            true => None,
            false => rows.last(column),
        };
        let mut this = Self {
            _lock: lock,
            resume_point,
            seconds_before: rows.last("seconds").unwrap_or(0.0),
            frames_before: rows.last("frames").unwrap_or(0),
            episodes_before: rows
                .last("episodes")
                .filter(|_| !resume_point.replay_is_kept)
                .unwrap_or(0),
            k_before: before("mean_k").zip(before("sd_k")),
            metrics: GrowingCsv::create(&folder.metrics(), &rows.header, &rows.rows)?,
            header: rows.header,
            events: None,
            returns,
            losses,
            processes: processes.to_vec(),
            rss_max: vec![None; processes.len()],
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

    /// The run has been going on for at least so many seconds.
    pub(crate) fn count_seconds_from(&mut self, seconds: f64) {
        self.seconds_before = self.seconds_before.max(seconds);
    }

    /// Mean and standard deviation of k over all `updates` of the run, before it was resumed too.
    fn k(&self, replay: &ReplayStatus, updates: u64) -> Option<(f64, f64)> {
        let since = replay.mean_k().zip(replay.sd_k());
        let (Some(before), Some(since)) = (self.k_before, since) else {
            return since.or(self.k_before);
        };
        // All updates are of as many rows.
        let share = self.resume_point.updates as f64 / updates.max(1) as f64;
        let mixed = |before: f64, since: f64| share * before + (1.0 - share) * since;
        let square = |(mean, sd): (f64, f64)| mean * mean + sd * sd;
        let mean = mixed(before.0, since.0);
        let variance = mixed(square(before), square(since)) - mean * mean;
        Some((mean, variance.max(0.0).sqrt()))
    }

    fn seconds(&self) -> f64 {
        self.seconds_before + self.started.elapsed().as_secs_f64()
    }

    /// Takes the state of the run: adds a row of metrics, in a resumed run once it is further than its last row, and the returns
    /// of the episodes that ended. `shards` are the replay servers' own accounts; `rss_mib` is in the order of the processes given at
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
        let said = self.returns.hear(shards);
        let (frames, updates) = (replay.transitions_inserted, learner.updates);
        let resumed = self.resume_point.updates > 0;
        if resumed && (updates <= self.resume_point.updates || frames < self.frames_before) {
            return said.into_iter().collect();
        }
        let processes = 0..self.processes.len();
        let moment = Moment {
            seconds: self.seconds(),
            rates: self.rates.per_second(),
            episodes: self.episodes(replay),
            k: self.k(replay, updates),
            replay,
            learner,
            losses: self.losses,
            rss_mib: processes
                .map(|i| rss_mib.get(i).copied().flatten())
                .collect(),
        };
        let row = moment.row();
        let events = self.events.as_mut();
        let drawn = events.and_then(|events| events.add(&row, replay, learner.finished));
        let written = self.metrics.add(row);
        said.into_iter().chain(written).chain(drawn).collect()
    }

    /// What to say about rows that could not be written up to now.
    pub fn missing(&self) -> Vec<String> {
        let events = self.events.as_ref().and_then(Events::missing);
        let missing = [self.metrics.missing(), self.returns.missing(), events];
        missing.into_iter().flatten().collect()
    }

    /// The whole run's episodes.
    pub fn episodes(&self, replay: &ReplayStatus) -> Episodes {
        Episodes {
            count: self.episodes_before + replay.episodes,
            mean_return: self.returns.mean(),
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
        let rss = self.processes.iter().zip(&self.rss_max);
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
            mean_k: self.k(replay, updates).map(|(mean, _)| mean),
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
