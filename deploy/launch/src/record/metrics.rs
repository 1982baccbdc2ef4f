//! The table of `metrics.csv`: its columns, a row, and the rows that a resumed run keeps.
//! It writes no file: the recorder does.

use std::{fs, io::ErrorKind, path::Path};

use anyhow::Context;
use driml_machine::error::usage;
use driml_protocol::{LearnerStatus, ReplayStatus};

use super::Episodes;
use crate::resume::Behind;

/// The columns of the metrics: the auxiliary `losses` stand between C51's and the total.
pub(super) fn header(losses: &[&str], processes: &[String]) -> Vec<String> {
    let counts = [
        "seconds",
        "frames",
        "updates",
        "frames_per_second",
        "updates_per_second",
        "replay_ratio",
        "episodes",
        "mean_return",
        "mean_return_of",
        "c51_kl",
    ];
    let rest = [
        "total_loss",
        "grad_norm",
        "q_mean",
        "mean_k",
        "sd_k",
        "mean_age",
        "weights_version",
        "affinity_version",
        "actors",
        "waiting",
    ];
    let rss = processes
        .iter()
        .map(|name| format!("rss_mib_{}", name.replace('-', "_")));
    let counts = counts.map(String::from).into_iter();
    counts
        .chain(losses.iter().map(ToString::to_string))
        .chain(rest.map(String::from))
        .chain(rss)
        .collect()
}

/// What a row of metrics says.
pub(super) struct Moment<'a> {
    /// Since the run's start, without the time between its interruption and its resumption.
    pub(super) seconds: f64,
    /// Frames and updates a second.
    pub(super) rates: (f64, f64),
    pub(super) episodes: Episodes,
    /// Mean and standard deviation of k.
    pub(super) k: Option<(f64, f64)>,
    pub(super) replay: &'a ReplayStatus,
    pub(super) learner: &'a LearnerStatus,
    /// The names of the agent's auxiliary losses.
    pub(super) losses: &'a [&'static str],
    /// Resident memory of each process, MiB; none for one that ended.
    pub(super) rss_mib: Vec<Option<f64>>,
}

impl Moment<'_> {
    /// The cells, in the order of [`header`].
    pub(super) fn row(&self) -> Vec<String> {
        let (replay, learner) = (self.replay, self.learner);
        let mean_return = self.episodes.mean_return;
        let some = |value: Option<f64>| value.map_or(String::new(), |value| format!("{value:.6}"));
        // What has not been computed is left empty: a 0 would look like a loss.
        let computed = |value: f64| some((learner.updates > 0).then_some(value));
        let mut row = vec![
            format!("{:.3}", self.seconds),
            replay.transitions_inserted.to_string(),
            learner.updates.to_string(),
            format!("{:.2}", self.rates.0),
            format!("{:.3}", self.rates.1),
            some(replay.replay_ratio()),
            self.episodes.count.to_string(),
            some(mean_return.map(|it| it.mean)),
            mean_return.map_or(0, |it| it.of).to_string(),
            computed(learner.c51_kl.into()),
        ];
        let losses = self.losses.iter().map(|name| learner.loss(name));
        row.extend(losses.map(|loss| some(loss.map(f64::from))));
        row.extend([
            computed(learner.total.into()),
            computed(learner.grad_norm),
            computed(learner.q_mean.into()),
            some(self.k.map(|(mean, _)| mean)),
            some(self.k.map(|(_, sd)| sd)),
            format!("{:.1}", replay.mean_age),
            learner.weights_version.to_string(),
            replay.affinity_version.to_string(),
            replay.actors.to_string(),
            replay.waiting.to_string(),
        ]);
        let rss = self.rss_mib.iter();
        row.extend(rss.map(|mib| mib.map_or(String::new(), |mib| format!("{mib:.1}"))));
        row
    }
}

/// Rows of metrics that a run begins with.
pub(super) struct Rows {
    pub(super) header: Vec<String>,
    pub(super) rows: Vec<csv::StringRecord>,
}

impl Rows {
    pub(super) const fn none(header: Vec<String>) -> Self {
        Self {
            header,
            rows: Vec::new(),
        }
    }

    /// The rows of an interrupted run up to what it has `behind` it, of no more than `frames_max` frames.
    pub(super) fn read(
        path: &Path,
        header: Vec<String>,
        behind: Behind,
        frames_max: u64,
    ) -> anyhow::Result<Self> {
        let reading = || format!("reading {}", path.display());
        let text = match fs::read(path) {
            Err(e) if e.kind() == ErrorKind::NotFound => return Ok(Self::none(header)),
            read => read.with_context(reading)?,
        };
        // What follows the last line's end was cut off.
        let whole = text.iter().rposition(|&byte| byte == b'\n');
        let mut reader = csv::Reader::from_reader(&text[..whole.map_or(0, |end| end + 1)]);
        let found = reader.headers().with_context(reading)?;
        if !found.is_empty() && found != header {
            return Err(usage!(
                "{} has other columns than a run of several processes by this version of driml: go on with the version that began it; a \
                 run in --lockstep is repeated, not resumed",
                path.display()
            )
            .into());
        }
        let mut this = Self::none(header);
        let rows: Vec<_> = reader
            .records()
            .collect::<Result<_, _>>()
            .with_context(reading)?;
        for row in rows {
            let count = |name| this.value::<u64>(&row, name);
            let (Some(updates), Some(frames)) = (count("updates"), count("frames")) else {
                return Err(usage!("{}: {row:?} is no row of metrics", path.display()).into());
            };
            // Actors run ahead: without the second condition a run that now ends sooner would end before its rows.
            if updates <= behind.updates && frames <= frames_max {
                this.rows.push(row);
            }
        }
        Ok(this)
    }

    pub(super) fn value<T: std::str::FromStr>(
        &self,
        row: &csv::StringRecord,
        name: &str,
    ) -> Option<T> {
        let column = self.header.iter().position(|it| it == name)?;
        row.get(column)?.parse().ok()
    }

    /// What the last row has in the column `name`.
    pub(super) fn last<T: std::str::FromStr>(&self, name: &str) -> Option<T> {
        self.value(self.rows.last()?, name)
    }
}
