//! Combines runs of one configuration and several seeds into one curve with a band.
//! Values between two recorded points are interpolated linearly.

use std::collections::{BTreeSet, VecDeque};

use driml_figure::Series;

use super::{
    flags::{Band, PlotArgs},
    names,
    runs::{Run, SD_OF_K},
};
use crate::stats::{Spread, interval};

const GRID_INTERVALS: usize = 240;
/// About the most points of a single run's curve. Of a longer curve the ends are drawn, and between them the lowest and highest of neighbours.
const POINTS_MAX: usize = 600;
/// Curves without a common x are still averaged if the gap is at most this share of x: evaluations of seeds are some frames apart.
const GAP_SHARE_MAX: f64 = 0.05;
const K_MIN: f64 = 1.0;

#[derive(Debug)]
pub(super) struct Group<'a> {
    pub(super) name: String,
    pub(super) runs: Vec<&'a Run>,
}

#[derive(Clone, Debug, Default)]
pub(crate) struct Curve {
    pub(crate) points: Vec<(f64, f64)>,
    pub(crate) band: Vec<(f64, f64, f64)>,
}

impl Curve {
    /// Returns the mean of the values at each x, and their band. An x without values is left out.
    pub(crate) fn from_values(all: impl IntoIterator<Item = (f64, Vec<f64>)>, band: Band) -> Self {
        let mut curve = Self::default();
        for (x, values) in all {
            let Some(spread) = Spread::of(values.iter().copied()) else {
                continue;
            };
            let mean = spread.mean;
            let ends = || interval(&values)?.ends;
            let (low, high) = match band {
                Band::Range => (spread.min, spread.max),
                Band::Sd => (mean - spread.sd, mean + spread.sd),
                Band::Ci => ends().unwrap_or((mean, mean)),
            };
            curve.points.push((x, mean));
            curve.band.push((x, low, high));
        }
        curve
    }

    pub(crate) fn series(self, name: &str, index: usize) -> Series {
        let points = match self.band[..] {
            [] => thin(&self.points),
            _ => self.points,
        };
        Series::line(name, index, points).with_band(self.band)
    }
}

/// Groups the runs in the order in which they are named. If `merge_seeds`, runs that differ at most in their seed form one group.
///
/// Settings that depend on the machine (threads, sizes, the replay's capacity) do not separate runs; the number of actors does.
pub(super) fn group_runs(runs: &[Run], merge_seeds: bool) -> Vec<Group<'_>> {
    let mut groups: Vec<Vec<&Run>> = Vec::new();
    for run in runs {
        let same = |group: &&mut Vec<&Run>| {
            merge_seeds && run.settings.is_some() && group[0].settings == run.settings
        };
        match groups.iter_mut().find(same) {
            Some(group) => group.push(run),
            None => groups.push(vec![run]),
        }
    }
    let named = names::group_names(&groups).into_iter().zip(groups);
    named.map(|(name, runs)| Group { name, runs }).collect()
}

impl Group<'_> {
    /// Warns of replays that hold different parts of their runs, which do not separate runs, as the free memory decides their default;
    /// and of repeated seeds, whose runs a band takes for independent ones.
    pub(super) fn warnings(&self) -> impl Iterator<Item = String> {
        let held: BTreeSet<_> = self.runs.iter().filter_map(|run| run.replay_held).collect();
        let ends = held.first().zip(held.last()).filter(|(a, b)| a != b);
        let replays = ends.map(|(least, most)| {
            format!("the replays of its runs hold {least} to {most} transitions (replay.capacity_transitions)")
        });
        let (mut seeds, mut each) = (BTreeSet::new(), self.runs.iter().filter_map(|run| run.seed));
        let repeated = each.find(|&seed| !seeds.insert(seed));
        let repeated = repeated.map(|seed| format!("several of its runs have the seed {seed}"));
        let found = [replays, repeated].into_iter().flatten();
        found.map(|what| format!("{}: {what}; --separate draws each", self.name))
    }

    pub(super) fn curve(&self, column: &str, args: &PlotArgs) -> anyhow::Result<Curve> {
        let mean = self.combine_seeds(column, args)?;
        let has_spread = self.runs.iter().all(|run| run.has_values(SD_OF_K));
        if column != "mean_k" || !has_spread {
            return Ok(mean);
        }
        let points = thin(&mean.points);
        let spread = self.combine_seeds(SD_OF_K, args)?.points;
        let band = points.iter().map(|&(x, k)| {
            let sd = interpolate(&spread, x);
            (x, (k - sd).max(K_MIN), k + sd)
        });
        let band = band.collect();
        Ok(Curve { points, band })
    }

    fn combine_seeds(&self, column: &str, args: &PlotArgs) -> anyhow::Result<Curve> {
        // Some runs have no evaluations.
        let with_values = self.runs.iter().filter(|run| run.has_values(column));
        let each = with_values.map(|run| {
            let values = run.values(args.x.column(), column)?;
            Ok(match args.smooth {
                Some(window) => smooth(&values, window as f64),
                None => values,
            })
        });
        let each = each.collect::<anyhow::Result<Vec<_>>>()?;
        Ok(combine_seeds(&each, args.band))
    }
}

/// Returns the only curve; or the mean and band of several curves over their common range of x, or at the middle of a small gap between
/// them.
pub(crate) fn combine_seeds(each: &[Vec<(f64, f64)>], band: Band) -> Curve {
    let curves: Vec<_> = each.iter().filter(|it| !it.is_empty()).collect();
    if let [only] = curves[..] {
        return Curve {
            points: only.clone(),
            band: Vec::new(),
        };
    }
    let starts = curves.iter().map(|curve| curve[0].0);
    let ends = curves.iter().map(|curve| curve[curve.len() - 1].0);
    let mut start = starts.fold(f64::NEG_INFINITY, f64::max);
    let mut end = ends.fold(f64::INFINITY, f64::min);
    if curves.is_empty() || start > end * (1.0 + GAP_SHARE_MAX) {
        return Curve::default();
    }
    if start > end {
        end = f64::midpoint(start, end);
        start = end;
    }
    let last = if start == end { 0 } else { GRID_INTERVALS };
    let means = (0..=last).map(|i| {
        let x = start + (end - start) * i as f64 / GRID_INTERVALS as f64;
        let values = curves.iter().map(|points| interpolate(points, x));
        (x, values.collect())
    });
    Curve::from_values(means, band)
}

/// Replaces each point by the mean over the points within `width` of x before it.
pub(crate) fn smooth(points: &[(f64, f64)], width: f64) -> Vec<(f64, f64)> {
    let mut window = VecDeque::new();
    let mut smooth = Vec::with_capacity(points.len());
    for &(x, y) in points {
        window.push_back((x, y));
        while window.front().is_some_and(|(first, _)| *first <= x - width) && window.len() > 1 {
            window.pop_front();
        }
        let sum: f64 = window.iter().map(|(_, y)| y).sum();
        smooth.push((x, sum / window.len() as f64));
    }
    smooth
}

fn thin(points: &[(f64, f64)]) -> Vec<(f64, f64)> {
    if points.len() <= POINTS_MAX {
        return points.to_vec();
    }
    let end = points.len() - 1;
    let extremes = |chunk: &[(f64, f64)]| {
        let by_y = |a: &&(f64, f64), b: &&(f64, f64)| a.1.total_cmp(&b.1);
        let (low, high) = (chunk.iter().min_by(by_y), chunk.iter().max_by(by_y));
        let mut ends: Vec<_> = low.into_iter().chain(high).copied().collect();
        ends.sort_by(|a, b| a.0.total_cmp(&b.0));
        ends
    };
    let inner = points[1..end].chunks(2 * points.len().div_ceil(POINTS_MAX));
    let mut thinned = vec![points[0]];
    thinned.extend(inner.flat_map(extremes));
    thinned.push(points[end]);
    thinned
}

/// Interpolates `points` linearly at `x`; beyond the ends, the value at the end. `points` must be sorted by x and not empty.
fn interpolate(points: &[(f64, f64)], x: f64) -> f64 {
    let after = points.partition_point(|point| point.0 < x);
    match (after.checked_sub(1).map(|i| points[i]), points.get(after)) {
        (Some((x0, y0)), Some(&(x1, y1))) => y0 + (y1 - y0) * (x - x0) / (x1 - x0),
        (Some((_, y)), None) | (None, Some(&(_, y))) => y,
        (None, None) => f64::NAN,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn between_points_lies_the_line() {
        let points = [(0.0, 1.0), (10.0, 3.0), (10.0, 5.0), (20.0, 6.0)];
        let found = [-1.0, 0.0, 5.0, 15.0, 99.0].map(|x| interpolate(&points, x));
        assert_eq!(found, [1.0, 1.0, 2.0, 5.5, 6.0]);
    }

    #[test]
    fn a_thinned_curve_keeps_its_extremes_and_its_ends() {
        let mut points: Vec<_> = (0..5000).map(|x| (f64::from(x), 1.0)).collect();
        (points[0].1, points[1234].1, points[1235].1, points[4999].1) = (2.0, 9.0, -9.0, 3.0);
        let drawn = thin(&points);
        assert!(drawn.len() <= POINTS_MAX + 2, "{}", drawn.len());
        assert!(drawn.is_sorted_by(|a, b| a.0 <= b.0));
        for at in [0, 1234, 1235, 4999] {
            assert!(drawn.contains(&points[at]), "{at}");
        }
    }

    #[test]
    fn a_band_of_standard_deviations_and_the_interval_of_student() {
        let curves = [1.0, 2.0, 4.5].map(|y| vec![(0.0, y), (10.0, y)]);
        // By hand: standard deviation sqrt(3.25) = 1.803, and 4.303 / sqrt(3) = 2.484 of it.
        for (band, low, high) in [
            (Band::Range, 1.0, 4.5),
            (Band::Sd, 0.697, 4.303),
            (Band::Ci, -1.979, 6.979),
        ] {
            let curve = combine_seeds(&curves, band);
            assert_eq!(curve.points[0], (0.0, 2.5));
            let (_, found_low, found_high) = curve.band[0];
            assert!((found_low - low).abs() < 1e-3 && (found_high - high).abs() < 1e-3);
        }
        for (later, points) in [(104.0, &[(102.0, 2.0)][..]), (150.0, &[])] {
            let apart = [vec![(100.0, 1.0)], vec![(later, 3.0)]];
            assert_eq!(combine_seeds(&apart, Band::Sd).points, points);
        }
    }
}
