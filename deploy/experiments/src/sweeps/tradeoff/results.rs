//! The results of each point: the benchmark, the runs of its seeds, and the returns of their agents. The page is made from these alone.

use std::collections::BTreeMap;

use super::menu::{Common, Dial, DialLevel, Point};
use crate::{
    stats::{Interval, difference, interval, mean},
    sweep::FinishedRun,
};

/// Numbers of the benchmark, or errors against the reference, by their column names in the data.
pub(super) type Numbers = BTreeMap<String, f64>;

#[derive(Default)]
pub(super) struct PointResult {
    /// The benchmark, and the errors with the weights of the first finished seed.
    pub(super) measured: Numbers,
    pub(super) seeds: Vec<SeedResult>,
}

pub(super) struct SeedResult {
    pub(super) seed: u32,
    pub(super) run: FinishedRun,
    /// Training return over seconds.
    pub(super) curve: Vec<(f64, f64)>,
    pub(super) greedy: Vec<f64>,
}

pub(super) struct Results {
    pub(super) common: Common,
    pub(super) levels: Vec<DialLevel>,
    pub(super) points: BTreeMap<String, PointResult>,
    pub(super) random: Vec<f64>,
    /// The requested levels without a run.
    pub(super) left_out: Vec<String>,
    pub(super) commands: Vec<String>,
}

#[derive(Clone, Copy)]
pub(super) struct Measure {
    pub(super) name: &'static str,
    pub(super) get: fn(&SeedResult) -> Option<f64>,
}

const fn measure(name: &'static str, get: fn(&SeedResult) -> Option<f64>) -> Measure {
    Measure { name, get }
}

pub(super) const GREEDY: Measure = measure("greedy_return", |it| mean(&it.greedy));
/// The mean return of the last 100 training episodes.
pub(super) const TRAINING: Measure = measure("training_return", |it| it.run.summary.mean_return);
/// `None` for a resumed run, whose time includes filling its replay and starting its processes again.
pub(super) const FRAMES_PER_SECOND: Measure = measure("frames_per_second", |it| {
    let summary = &it.run.summary;
    (summary.resumed_after_updates == 0).then_some(summary.frames_per_second)
});
pub(super) const MEASURES: [Measure; 7] = [
    GREEDY,
    TRAINING,
    FRAMES_PER_SECOND,
    measure("wall_seconds", |it| Some(it.run.summary.wall_seconds)),
    // The sum over all processes of their highest resident memory.
    measure("rss_mib", |it| {
        Some(it.run.summary.rss_mib_max.values().flatten().sum())
    }),
    // The median number of updates by which the acting weights were behind.
    measure("weights_behind_updates", |it| {
        Some(it.run.summary.replay.weights_behind_updates?.p50)
    }),
    // The median number of seconds for which newer weights had existed.
    measure("weights_behind_seconds", |it| {
        Some(it.run.summary.replay.weights_behind_s?.p50)
    }),
];

impl PointResult {
    pub(super) fn values(&self, measure: Measure) -> Vec<f64> {
        self.seeds.iter().filter_map(measure.get).collect()
    }

    /// The seeds whose runs were not resumed: the time of others includes filling the replay and starting processes again.
    pub(super) fn uninterrupted(&self) -> impl Iterator<Item = &SeedResult> {
        let seeds = self.seeds.iter();
        seeds.filter(|it| it.run.summary.resumed_after_updates == 0)
    }

    pub(super) fn mean(&self, measure: Measure) -> Option<Interval> {
        interval(&self.values(measure))
    }
}

/// A base or a level of a dial: a row of the tables.
pub(super) struct Row<'a> {
    pub(super) dial: &'a Dial,
    pub(super) name: &'a str,
    pub(super) point: &'a Point,
    pub(super) is_base: bool,
    pub(super) result: &'a PointResult,
    pub(super) base: &'a PointResult,
}

impl Row<'_> {
    /// Returns level minus base, with its interval. Seeds are not paired: with real processes, two runs of one seed differ.
    pub(super) fn difference(&self, measure: Measure) -> Option<Interval> {
        difference(&self.base.values(measure), &self.result.values(measure))
    }

    /// Returns the level's frames per second divided by the base's, over the seeds that both have. Further seeds of a base run at another
    /// time, beside other runs.
    pub(super) fn frames_gain(&self) -> Option<f64> {
        let mean_of = |point: &PointResult, other: &PointResult| {
            let both = |it: &&SeedResult| other.uninterrupted().any(|that| that.seed == it.seed);
            let values = point.seeds.iter().filter(both);
            mean(&values.filter_map(FRAMES_PER_SECOND.get).collect::<Vec<_>>())
        };
        Some(mean_of(self.result, self.base)? / mean_of(self.base, self.result)?)
    }
}

impl Results {
    /// Returns for each dial with runs the base, followed by the levels.
    pub(super) fn rows_by_dial<'a>(&'a self) -> impl Iterator<Item = Vec<Row<'a>>> {
        let dials = self.levels.chunk_by(|a, b| a.dial.name == b.dial.name);
        dials.map(move |levels| {
            let DialLevel { dial, base, .. } = &levels[0];
            let row = |name: &'a str, point: &'a Point, is_base| Row {
                dial,
                name,
                point,
                is_base,
                result: &self.points[&point.key],
                base: &self.points[&base.key],
            };
            let base = row(&dial.base, base, true);
            let levels = levels.iter().map(|it| row(&it.level, &it.point, false));
            std::iter::once(base).chain(levels).collect()
        })
    }

    pub(super) fn level_rows(&self) -> impl Iterator<Item = Row<'_>> {
        self.rows_by_dial().flatten().filter(|row| !row.is_base)
    }
}
