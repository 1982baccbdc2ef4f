//! The figures of a trade-off: return against speed with the Pareto front of the levels, and return against wall-clock time.

use driml_figure::{Axis, Chart, Figure, GREY, Mark, Panel, Series};

use super::results::{FRAMES_PER_SECOND, Measure, PointResult, Results};
use crate::{
    plot::{Band, combine_seeds},
    stats::Spread,
};

const COLUMNS: usize = 3;
const PANEL: (f64, f64) = (330.0, 250.0);

#[derive(Clone, Copy, Debug, PartialEq)]
struct Marker {
    speed: f64,
    value: f64,
    ends: [f64; 2],
}

/// Draws return against frames per second: a panel for each dial with its base, all with the same axes. A dashed line joins the Pareto
/// front of all dials. `returns` selects the return, and `name` is its name.
pub(super) fn pareto_figure(results: &Results, returns: Measure, name: &str) -> Figure {
    let of_runs = results.points.values().flat_map(|it| it.values(returns));
    let all = Spread::of(of_runs);
    let (least, greatest) = all.map_or((0.0, 0.0), |it| (it.min, it.max));
    let place = |point: &PointResult| place(point, returns, (least, greatest));
    let placed: Vec<Marker> = results.points.values().filter_map(place).collect();
    let front: Vec<(f64, f64)> = front(&placed).map(|it| (it.speed, it.value)).collect();
    let speeds: Vec<f64> = placed.iter().map(|it| it.speed).collect();
    let values: Vec<f64> = placed.iter().flat_map(|it| it.ends).collect();
    let label = format!("{name} return");
    let panels = results.rows_by_dial().map(|rows| {
        let line = Series::line("", 0, front.clone());
        let mut series = vec![line.with_colour(GREY).with_mark(Mark::Dashed)];
        for (index, row) in rows.iter().enumerate() {
            let Some(it) = place(row.result) else {
                continue;
            };
            let point = Series::line(row.name, index, vec![(it.speed, it.value)]);
            let bar = vec![(it.speed, it.ends[0], it.ends[1])];
            series.push(point.with_band(bar).with_mark(Mark::Bars));
        }
        let (x, y) = (Axis::linear("frames/s"), Axis::linear(&label));
        let (x, y) = (x.covering(&speeds), y.covering(&values));
        Panel::Chart(Chart::new(&rows[0].dial.name, x, y, series))
    });
    Figure {
        title: format!("{}: {label} against speed", results.common.env),
        notes: vec![
            format!(
                "Return ({name}), mean over seeds, and frames a second of whole runs; to the upper right is better."
            ),
            "Bars: 95% intervals, cut at the least and the greatest return of any run.".into(),
            "The dashed line is the same in all: it joins the levels of all dials than which no other is better in both.".into(),
        ],
        columns: COLUMNS,
        panel_size: PANEL,
        panels: panels.collect(),
    }
}

/// Returns the position of a point. Its interval is cut to the range of all returns, because few seeds may give a far wider one.
fn place(point: &PointResult, returns: Measure, (least, greatest): (f64, f64)) -> Option<Marker> {
    let value = point.mean(returns)?;
    let (low, high) = value.ends.unwrap_or((value.mean, value.mean));
    Some(Marker {
        speed: point.mean(FRAMES_PER_SECOND)?.mean,
        value: value.mean,
        ends: [low.max(least), high.min(greatest)],
    })
}

/// Returns the Pareto front, the slowest point first: no other point is faster and no worse, or better and no slower.
fn front(placed: &[Marker]) -> impl Iterator<Item = Marker> {
    let beaten = |it: &Marker| {
        placed.iter().any(|other| {
            other.speed >= it.speed
                && other.value >= it.value
                && (other.speed > it.speed || other.value > it.value)
        })
    };
    let mut front: Vec<_> = placed.iter().filter(|it| !beaten(it)).copied().collect();
    front.sort_by(|a, b| a.speed.total_cmp(&b.speed));
    front.into_iter()
}

/// Draws the training return over seconds, with a panel for each dial and its base.
pub(super) fn wall_figure(results: &Results) -> Figure {
    let panels = results.rows_by_dial().map(|rows| {
        let series = rows.iter().enumerate().map(|(index, row)| {
            let each = row.result.seeds.iter().map(|it| it.curve.clone());
            let curve = combine_seeds(&each.collect::<Vec<_>>(), Band::Range);
            curve.series(row.name, index)
        });
        let (x, y) = (Axis::linear("seconds"), Axis::linear("mean return"));
        Panel::Chart(Chart::new(&rows[0].dial.name, x, y, series.collect()))
    });
    Figure {
        title: format!("{}: return against wall-clock time", results.common.env),
        notes: vec![
            "Training return, mean of the last 100 episodes; mean and range over seeds. Every run has the same number of frames."
                .into(),
        ],
        columns: COLUMNS,
        panel_size: PANEL,
        panels: panels.collect(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_front_has_what_no_other_beats() {
        let at = |speed: f64, value: f64| Marker {
            speed,
            value,
            ends: [value; 2],
        };
        let (slow_and_good, slow_and_bad) = (at(1.0, 9.0), at(1.0, 2.0));
        let (between, beaten, fast_and_bad) = (at(3.0, 5.0), at(2.0, 4.9), at(5.0, 3.0));
        let all = [slow_and_good, slow_and_bad, fast_and_bad, between, beaten];
        let front: Vec<_> = front(&all).collect();
        assert_eq!(front, [slow_and_good, between, fast_and_bad]);
    }
}
