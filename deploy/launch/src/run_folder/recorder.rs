//! What is written into the run folder during a run: settings, metrics, episodes, events on request, and the summary at its end.
//! It asks no process: its caller hands a view over.

use std::{
    fmt::Display,
    fs::{self, File},
    time::Instant,
};

use anyhow::Context;
use driml_protocol::{EpisodesReply, ReplayStatus, RunSpec};
use driml_settings::config::RunConfig;

use super::{
    episodes::TrainingEpisodes,
    events::Events,
    folder::RunFolder,
    metrics::{ResumePoint, rows_up_to, seconds_of},
    summary::{Outcome, Summary},
    table::{AppendLog, Table, csv_row},
};
use crate::{
    metrics::{cells, points},
    moment::{Episodes, Moment, Spread},
    run_view::{Plan, RunView},
};

/// What a recorder knows of a run before it begins.
#[derive(Clone, Debug, Default)]
pub struct Recorded {
    /// The settings, as `config.toml` has them.
    pub config_toml: String,
    /// The names of the agent's auxiliary losses.
    pub losses: &'static [&'static str],
    /// The processes whose memory is recorded.
    pub processes: Vec<String>,
}

impl Recorded {
    pub(crate) fn of(config: &RunConfig, processes: Vec<String>) -> Self {
        Self {
            config_toml: config.to_toml(),
            losses: config.learner.update.objective.losses(),
            processes,
        }
    }

    pub(super) fn header(&self) -> Vec<String> {
        let nothing = RunView::new(Plan::default());
        let cells = cells(&self.moment(&nothing, &[]));
        cells.into_iter().map(|(name, _)| name).collect()
    }

    /// What a view says, of this run's losses and processes; their memory is in the order of the processes.
    fn moment<'a>(&'a self, view: &'a RunView, rss_mib: &[Option<f64>]) -> Moment<'a> {
        let memory = rss_mib.iter().copied().chain(std::iter::repeat(None));
        let processes = self.processes.iter().map(String::as_str);
        Moment {
            // Until it answers it has its last status.
            learner: Some(&view.learner),
            losses: self.losses.to_vec(),
            rss_mib: processes.zip(memory).collect(),
            ..view.moment()
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
    /// The k of all rows up to there.
    k_before: Option<Spread>,
    metrics: AppendLog,
    events: Option<Events>,
    episodes: TrainingEpisodes,
    /// The next episodes that arrive had ended before.
    is_late: bool,
    run: Recorded,
    /// Resident memory of each process, now and at the most.
    rss_mib: Vec<Option<f64>>,
    rss_max: Vec<Option<f64>>,
    started: Instant,
}

impl RunRecorder {
    /// Records a run with these settings and processes in `folder`: one that begins, or that is `resumed` from there.
    pub(crate) fn open(
        folder: &RunFolder,
        config: &RunConfig,
        processes: Vec<String>,
        resumed: Option<ResumePoint>,
    ) -> anyhow::Result<Self> {
        let recorded = Recorded::of(config, processes);
        let mut this = match resumed {
            Some(point) => Self::go_on(folder, recorded, point, config.frames())?,
            None => Self::create(folder, recorded)?,
        };
        if config.local.tensorboard {
            this.write_events(folder)?;
        }
        Ok(this)
    }

    /// Makes the folder and writes the settings; the clock starts.
    pub fn create(folder: &RunFolder, run: Recorded) -> anyhow::Result<Self> {
        folder.check_free()?;
        fs::create_dir_all(folder.path())
            .with_context(|| format!("making the run folder {}", folder.display()))?;
        let lock = folder.lock()?;
        folder.write_config(&run.config_toml)?;
        let (header, rows) = (run.header(), Vec::new());
        let rows = Table { header, rows };
        let episodes = TrainingEpisodes::create(folder)?;
        Self::begin(folder, run, lock, rows, episodes, ResumePoint::default())
    }

    /// Continues from `resume_point` to `frames_max` frames in the folder of an interrupted run: the rows of metrics up
    /// to there stay.
    pub(crate) fn go_on(
        folder: &RunFolder,
        run: Recorded,
        resume_point: ResumePoint,
        frames_max: u64,
    ) -> anyhow::Result<Self> {
        let lock = folder.lock()?;
        let seconds = seconds_of(folder);
        let rows = rows_up_to(&folder.metrics(), run.header(), resume_point, frames_max)?;
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
        rows: Table,
        episodes: TrainingEpisodes,
        resume_point: ResumePoint,
    ) -> anyhow::Result<Self> {
        // A replay that was kept knows of all the run's episodes and k.
        let is_kept = resume_point.replay_is_kept;
        let before = |column| rows.last(column).filter(|_| !is_kept);
        let rows_of_episodes = rows.last("episodes").unwrap_or(0).max(episodes.episode);
        Ok(Self {
            _lock: lock,
            resume_point,
            seconds_before: rows.last("seconds").unwrap_or(0.0),
            frames_before: resume_point.frames,
            episodes_before: if is_kept { 0 } else { rows_of_episodes },
            k_before: (before("mean_k").zip(before("sd_k"))).map(|(mean, sd)| Spread { mean, sd }),
            metrics: AppendLog::create(&folder.metrics(), &rows.text())?,
            events: None,
            episodes,
            is_late: false,
            rss_mib: Vec::new(),
            rss_max: vec![None; run.processes.len()],
            run,
            started: Instant::now(),
        })
    }

    pub(crate) fn write_events(&mut self, folder: &RunFolder) -> anyhow::Result<()> {
        let kept = (self.resume_point.updates > 0).then_some(self.frames_before);
        self.events = Some(Events::create(folder, kept)?);
        Ok(())
    }

    /// The run has taken at least so many seconds before this recorder started.
    pub(crate) fn count_seconds_from(&mut self, seconds: f64) {
        self.is_late = true;
        self.count_seconds(seconds);
    }

    fn count_seconds(&mut self, seconds: f64) {
        self.seconds_before = self.seconds_before.max(seconds);
    }

    /// The k of all rows of the run, before it was resumed too.
    fn k(&self, replay: &ReplayStatus, since: Option<Spread>) -> Option<Spread> {
        let (Some(before), Some(since)) = (self.k_before, since) else {
            return since.or(self.k_before);
        };
        let rows = replay.rows_sampled.max(self.resume_point.rows).max(1);
        let share = self.resume_point.rows as f64 / rows as f64;
        let mixed = |before: f64, since: f64| share * before + (1.0 - share) * since;
        let square = |it: Spread| it.mean * it.mean + it.sd * it.sd;
        let mean = mixed(before.mean, since.mean);
        let variance = mixed(square(before), square(since)) - mean * mean;
        let sd = variance.max(0.0).sqrt();
        Some(Spread { mean, sd })
    }

    /// What a view says of the whole run, before it was resumed too.
    pub fn moment<'a>(&'a self, view: &'a RunView) -> Moment<'a> {
        let moment = self.run.moment(view, &self.rss_mib);
        Moment {
            seconds: Some(self.seconds()),
            episodes: self.episodes(&view.replay),
            k: self.k(&view.replay, moment.k),
            ..moment
        }
    }

    fn seconds(&self) -> f64 {
        self.seconds_before + self.started.elapsed().as_secs_f64()
    }

    /// Asks for the episodes that ended since the last time: those of a shard after the first so many. Warnings are returned as by
    /// [`Self::record`], which is to follow.
    pub(crate) fn record_episodes<E: Display>(
        &mut self,
        view: &RunView,
        ask: impl Fn(usize, u64) -> Result<EpisodesReply, E>,
    ) -> Vec<String> {
        let seconds = (!std::mem::take(&mut self.is_late)).then(|| self.seconds());
        self.episodes.update(&view.shards, ask, seconds)
    }

    /// [`Self::record_episodes`], then [`Self::record`].
    pub(crate) fn record_all<E: Display>(
        &mut self,
        view: &RunView,
        rss_mib: &[Option<f64>],
        ask: impl Fn(usize, u64) -> Result<EpisodesReply, E>,
    ) -> Vec<String> {
        let mut warnings = self.record_episodes(view, ask);
        warnings.extend(self.record(view, rss_mib));
        warnings
    }

    /// Takes the state of the run: adds a row of metrics, in a resumed run once it is further than its last row.
    /// `rss_mib` is in the order of the processes given at the start, none for one that ended.
    ///
    /// A disk that is full does not end the run: a warning is returned the first time, and [`Self::missing`] says
    /// at the end what was lost.
    pub fn record(&mut self, view: &RunView, rss_mib: &[Option<f64>]) -> Vec<String> {
        self.rss_mib = rss_mib.to_vec();
        for (max, now) in self.rss_max.iter_mut().zip(rss_mib) {
            *max = now.map_or(*max, |now| Some(max.map_or(now, |max: f64| max.max(now))));
        }
        let (frames, updates) = (view.replay.transitions_inserted, view.learner.updates);
        let resumed = self.resume_point.updates > 0;
        if resumed && (updates <= self.resume_point.updates || frames < self.frames_before) {
            return Vec::new();
        }
        let moment = self.moment(view);
        let row = csv_row(cells(&moment).into_iter().map(|(_, cell)| cell));
        let points = points(&moment);
        let events = self.events.as_mut();
        let drawn = events.and_then(|it| it.add(&points, &view.replay, view.learner.finished));
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
        self.episodes.so_far(self.episodes_before + replay.episodes)
    }

    /// What there is to say of the run, which ended so.
    pub fn summarise(&self, outcome: Outcome, run: &RunSpec, view: &RunView) -> Summary {
        let wall_seconds = self.seconds();
        let moment = self.moment(view);
        let of_view = Summary::of(outcome, run, view, moment.episodes, wall_seconds);
        // A resumed run that did not get anywhere still has what was done before.
        let frames = of_view.frames.max(self.resume_point.frames);
        let updates = of_view.updates.max(self.resume_point.updates);
        let rss = self.run.processes.iter().zip(&self.rss_max);
        let rss = rss.map(|(name, mib)| (name.clone(), mib.map(f64::round).into()));
        Summary {
            resumed_after_updates: self.resume_point.updates,
            frames,
            updates,
            frames_per_second: frames as f64 / wall_seconds,
            updates_per_second: updates as f64 / wall_seconds,
            mean_k: moment.k.map(|it| it.mean),
            rss_mib_max: rss.collect(),
            ..of_view
        }
    }
}

#[cfg(test)]
#[path = "recorder_tests.rs"]
mod tests;
