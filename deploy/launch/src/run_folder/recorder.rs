//! Writes the files of the run folder during a run: settings, metrics, episodes, events on request, and the summary at the end.
//! This module asks no process: its caller passes a view of the run.

use std::{fs::File, time::Instant};

use driml_protocol::{EpisodesReply, ReplayStatus};
use driml_settings::config::RunConfig;

use super::{
    episodes::TrainingEpisodes,
    events::Events,
    folder::RunFolder,
    metrics::{BeforeReplay, ResumePoint, rows_up_to},
    summary::{Outcome, Summary},
    table::{AppendLog, Table, csv_row},
};
use crate::{
    metrics::{csv_cells, curve_points},
    output::make_folder,
    run_view::{Episodes, Plan, RunView, Spread},
};

/// Writes the files of a run folder.
#[derive(Debug)]
pub struct RunRecorder {
    /// While this lock is held, no other launcher writes to the folder.
    _lock: File,
    resume_point: ResumePoint,
    before_replay: BeforeReplay,
    metrics: AppendLog,
    events: Option<Events>,
    episodes: TrainingEpisodes,
    /// Whether the next episodes to arrive ended before the run was watched, at unknown times.
    are_times_unknown: bool,
    /// Resident memory of each process by name, MiB: now, and the highest so far.
    rss_mib: Vec<(String, Option<f64>)>,
    rss_max: Vec<Option<f64>>,
    started: Instant,
}

impl RunRecorder {
    /// Records a run with these settings in `folder`, with the memory of `processes` and, on request, TensorBoard `events`. A run that
    /// begins gets a new folder; a run that is `resumed` keeps its rows up to that point. The clock starts.
    pub fn open(
        folder: &RunFolder,
        config: &RunConfig,
        processes: Vec<String>,
        resumed: Option<ResumePoint>,
        events: bool,
    ) -> anyhow::Result<Self> {
        if resumed.is_none() {
            folder.check_free()?;
            make_folder("--run-dir", folder.path())?;
        }
        let lock = folder.lock()?;
        let header = header(config, &processes);
        let resume_point = resumed.unwrap_or_default();
        let earlier = BeforeReplay::read(folder);
        let seconds_summarised = Summary::read(folder).map_or(0.0, |it| it.wall_seconds);
        let seconds_noted = earlier.as_ref().map_or(0.0, |it| it.seconds);
        let seconds_before = seconds_noted.max(seconds_summarised);
        let kept = resume_point.replay_is_kept.then_some(earlier).transpose()?;
        let (rows, seconds) = match resumed {
            None => {
                // First, because a folder in which nothing was learned is recognised as a run's by its settings.
                folder.write_config(config)?;
                let rows = Vec::new();
                (Table { header, rows }, 0.0)
            }
            Some(point) => {
                let (rows, seconds) = rows_up_to(&folder.metrics(), header, point)?;
                (rows, seconds.max(seconds_before))
            }
        };
        let unknown = kept.map(|it| it.episodes);
        let episodes = TrainingEpisodes::open(folder, resumed.map(|it| it.frames), unknown)?;
        if resumed.is_some() {
            folder.write_config(config)?;
        }
        Summary::remove(folder)?;
        let mut before_replay = kept.unwrap_or_else(|| BeforeReplay {
            after_updates: resume_point.after_updates,
            rows: resume_point.rows,
            episodes: rows.last("episodes").unwrap_or(0).max(episodes.newest),
            k: (rows.last("mean_k").zip(rows.last("sd_k"))).map(|(mean, sd)| Spread { mean, sd }),
            seconds: 0.0,
        });
        before_replay.seconds = seconds;
        if resumed.is_some() {
            before_replay.write(folder)?;
        }
        let events = events.then(|| Events::create(folder, resume_point.frames));
        Ok(Self {
            _lock: lock,
            resume_point,
            before_replay,
            metrics: AppendLog::create(&folder.metrics(), &rows.to_csv())?,
            events: events.transpose()?,
            episodes,
            are_times_unknown: false,
            rss_max: vec![None; processes.len()],
            rss_mib: processes.into_iter().map(|name| (name, None)).collect(),
            started: Instant::now(),
        })
    }

    /// Notes that the run took at least this many seconds before this recorder started.
    pub(crate) fn raise_seconds_before(&mut self, seconds: f64) {
        self.are_times_unknown = true;
        self.before_replay.seconds = self.before_replay.seconds.max(seconds);
    }

    /// k over all rows of the run, including those before a resume.
    fn k_spread(&self, replay: &ReplayStatus) -> Option<Spread> {
        let since = Spread::of_k(replay);
        let (Some(before), Some(since)) = (self.before_replay.k, since) else {
            return since.or(self.before_replay.k);
        };
        let rows = replay.rows_sampled.max(self.before_replay.rows).max(1);
        let share = self.before_replay.rows as f64 / rows as f64;
        let mixed = |before: f64, since: f64| share * before + (1.0 - share) * since;
        let square = |it: Spread| it.mean * it.mean + it.sd * it.sd;
        let mean = mixed(before.mean, since.mean);
        let variance = mixed(square(before), square(since)) - mean * mean;
        let sd = variance.max(0.0).sqrt();
        Some(Spread { mean, sd })
    }

    /// Fills the numbers of the whole run into a view, including those from before a resume.
    pub(crate) fn fill_totals(&self, view: &mut RunView) {
        view.recorded_s = Some(self.seconds());
        view.episodes = self.total_episodes(&view.replay);
        view.k = self.k_spread(&view.replay);
        view.rss_mib.clone_from(&self.rss_mib);
    }

    fn seconds(&self) -> f64 {
        self.before_replay.seconds + self.started.elapsed().as_secs_f64()
    }

    /// Records the episodes that ended since the last call. `fetch(shard, count)` requests the episodes of a shard after the first
    /// `count`; none if the shard does not answer. Returns warnings as [`Self::record`] does; call that method next.
    pub(crate) fn record_episodes(
        &mut self,
        view: &RunView,
        fetch: impl Fn(usize, u64) -> Option<EpisodesReply>,
    ) -> Vec<String> {
        let seconds = (!std::mem::take(&mut self.are_times_unknown)).then(|| self.seconds());
        self.episodes.update(&view.shards, fetch, seconds)
    }

    /// Adds a row of metrics for the state of the run; a resumed run adds rows once it has passed its resume point.
    /// `rss_mib` is in the order of the processes given at the start, none for a process that has ended.
    ///
    /// A full disk does not end the run: a warning is returned the first time, and [`Self::loss_messages`] reports at the end what
    /// was lost.
    pub fn record(&mut self, view: &mut RunView, rss_mib: &[Option<f64>]) -> Vec<String> {
        let known = rss_mib.iter().copied().chain(std::iter::repeat(None));
        for (((_, rss), max), now) in self.rss_mib.iter_mut().zip(&mut self.rss_max).zip(known) {
            *rss = now;
            *max = now.into_iter().chain(*max).reduce(f64::max);
        }
        self.fill_totals(view);
        let (frames, updates) = (view.replay.transitions_inserted, view.learner.updates);
        let before = &self.resume_point;
        if before.updates > 0 && (updates <= before.updates || frames < before.frames) {
            return Vec::new();
        }
        let row = csv_row(csv_cells(view).into_iter().map(|(_, cell)| cell));
        let points = curve_points(view);
        let events = self.events.as_mut();
        let drawn = events.and_then(|it| it.add(&points, &view.replay, view.learner.finished));
        self.metrics.add([row]).into_iter().chain(drawn).collect()
    }

    /// Messages about rows that could not be written so far.
    pub fn loss_messages(&self) -> Vec<String> {
        let events = self.events.as_ref().and_then(|it| it.file.loss_message());
        let mut missing = self.episodes.loss_messages();
        missing.extend([self.metrics.loss_message(), events].into_iter().flatten());
        missing
    }

    pub(crate) fn total_episodes(&self, replay: &ReplayStatus) -> Episodes {
        self.episodes
            .so_far(self.before_replay.episodes + replay.episodes)
    }

    /// The summary of the run, which ended with `outcome`.
    pub fn summarise(&self, outcome: Outcome, view: &mut RunView) -> Summary {
        self.fill_totals(view);
        let rss = self.rss_mib.iter().zip(&self.rss_max);
        let rss = rss.map(|((name, _), mib)| (name.clone(), mib.map(f64::round)));
        Summary {
            rss_mib_max: rss.collect(),
            ..Summary::new(outcome, view, self.seconds(), self.resume_point)
        }
    }
}

fn header(config: &RunConfig, processes: &[String]) -> Vec<String> {
    let mut nothing = RunView::new(Plan::new(config));
    nothing.rss_mib = processes.iter().map(|it| (it.clone(), None)).collect();
    csv_cells(&nothing).into_iter().map(|it| it.0).collect()
}

#[cfg(test)]
mod tests;
