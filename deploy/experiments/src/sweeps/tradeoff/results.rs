//! What was measured at each point: the bench, the runs of its seeds and how their agents play. All of the page is made from it.

use std::collections::BTreeMap;

use super::{
    dials::{Dial, Point},
    exactness::Exactness,
    settings::Settings,
    speed::Speed,
};
use crate::{
    stats::{Difference, Interval, Spread, difference, interval},
    sweep::plan::FinishedRun,
};

/// A level of a dial and its base.
#[derive(Clone, Debug)]
pub(super) struct LevelOf {
    pub(super) dial: Dial,
    pub(super) level: String,
    pub(super) base: Point,
    pub(super) point: Point,
}

impl LevelOf {
    /// As the page has it.
    pub(super) fn name(&self) -> String {
        format!("{} = {}", self.dial.name, self.level)
    }
}

/// What a point gave.
pub(super) struct PointResult {
    pub(super) speed: Option<Speed>,
    /// At the weights of its first seed.
    pub(super) exactness: Option<Exactness>,
    pub(super) seeds: Vec<SeedResult>,
}

/// A finished run and the returns of its agent, played greedily.
pub(super) struct SeedResult {
    pub(super) seed: u32,
    pub(super) ran: FinishedRun,
    pub(super) greedy: Vec<f64>,
}

/// All there is to report.
pub(super) struct Results {
    pub(super) settings: Settings,
    /// Levels that have runs, as their bases do.
    pub(super) levels: Vec<LevelOf>,
    /// By the point's key.
    pub(super) points: BTreeMap<String, PointResult>,
    /// Returns of the random policy.
    pub(super) random: Vec<f64>,
    /// Levels that have no run.
    pub(super) left_out: Vec<String>,
    /// Runs that failed.
    pub(super) missing: Vec<String>,
    /// The calls that made it.
    pub(super) commands: Vec<String>,
    pub(super) smoke: bool,
}

/// Which number of a run.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Measure {
    /// Mean of the greedily played episodes.
    Greedy,
    /// Mean of the last 100 training episodes.
    Training,
    FramesPerSecond,
    WallSeconds,
    /// Highest resident memory of all processes, MiB.
    Memory,
    /// Updates by which the weights that acted were behind, median.
    Behind,
    /// Seconds for which newer weights had been there, median.
    BehindSeconds,
}

impl SeedResult {
    pub(super) fn value(&self, measure: Measure) -> Option<f64> {
        let summary = &self.ran.summary;
        match measure {
            Measure::Greedy => Spread::of(self.greedy.iter().copied()).map(|it| it.mean),
            Measure::Training => summary.mean_return,
            Measure::FramesPerSecond => Some(summary.frames_per_second),
            Measure::WallSeconds => Some(summary.wall_seconds),
            Measure::Memory => {
                let each = summary.rss_mib_max.values();
                Some(each.filter_map(serde_json::Value::as_f64).sum())
            }
            Measure::Behind => summary.weights_behind_updates.map(|it| it.p50),
            Measure::BehindSeconds => summary.weights_behind_s.map(|it| it.p50),
        }
    }
}

impl PointResult {
    /// What each run gave, by its seed.
    pub(super) fn values(&self, measure: Measure) -> Vec<f64> {
        self.seeds
            .iter()
            .filter_map(|it| it.value(measure))
            .collect()
    }

    /// The mean over seeds, with its interval.
    pub(super) fn mean(&self, measure: Measure) -> Option<Interval> {
        interval(&self.values(measure))
    }
}

impl Results {
    /// The levels of each dial that has runs.
    pub(super) fn by_dial(&self) -> impl Iterator<Item = &[LevelOf]> {
        self.levels.chunk_by(|a, b| a.dial.name == b.dial.name)
    }

    /// Fewest and most seeds of the bases, and of the other levels.
    pub(super) fn seeds(&self) -> [Option<(usize, usize)>; 2] {
        [true, false].map(|bases| {
            let is_base = |key: &str| self.levels.iter().any(|of| of.base.key == key);
            let all = self.points.iter();
            let counts = all.filter(|(key, _)| is_base(key) == bases);
            let counts: Vec<usize> = counts.map(|(_, point)| point.seeds.len()).collect();
            Some((*counts.iter().min()?, *counts.iter().max()?))
        })
    }

    /// Level minus base, with its interval. Seeds are not paired: through real processes no two runs of a seed are alike.
    pub(super) fn difference(&self, of: &LevelOf, measure: Measure) -> Option<Difference> {
        let [base, level] = [&of.base, &of.point].map(|it| self.points[&it.key].values(measure));
        difference(&base, &level)
    }

    /// The level's mean over the base's, of the seeds that both have: a base's further seeds run at another time, beside other runs.
    pub(super) fn factor(&self, of: &LevelOf, measure: Measure) -> Option<f64> {
        let [base, level] = [&of.base, &of.point].map(|it| &self.points[&it.key]);
        let mean = |point: &PointResult, other: &PointResult| {
            let both = |it: &&SeedResult| other.seeds.iter().any(|of| of.seed == it.seed);
            let values = point.seeds.iter().filter(both);
            Spread::of(values.filter_map(|it| it.value(measure))).map(|it| it.mean)
        };
        Some(mean(level, base)? / mean(base, level)?)
    }

    /// What a base earns in training more than the random policy, over seeds and over episodes of the latter.
    pub(super) fn above_random(&self, base: &PointResult) -> Option<Difference> {
        difference(&self.random, &base.values(Measure::Training))
    }
}
