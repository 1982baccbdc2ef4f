//! The pictures of a trade-off: return against speed with the levels that no other beats in both, and return against wall-clock time.

use driml_figure::{Axis, Chart, Figure, GREY, Mark, Panel, Series};

use super::results::{Measure, PointResult, Results};
use crate::plot::{Over, Run, over_seeds};

/// A point in return and speed.
#[derive(Clone, Debug)]
struct Placed {
    name: String,
    speed: f64,
    value: f64,
    ends: (f64, f64),
}

/// Return against frames a second, of every point; a dashed line joins those that no other beats in both.
pub(super) fn pareto(results: &Results) -> Figure {
    let mut placed = Vec::new();
    for (key, point) in &results.points {
        placed.extend(place(name(results, key), point));
    }
    let front = front(&placed);
    let line: Vec<(f64, f64)> = front.iter().map(|it| (it.speed, it.value)).collect();
    let mut series = vec![
        Series::line("not beaten in both", 0, line)
            .coloured(GREY)
            .marked(Mark::Dashed),
    ];
    for (index, it) in placed.iter().enumerate() {
        series.push(
            Series::line(&it.name, index, vec![(it.speed, it.value)])
                .banded(vec![(it.speed, it.ends.0, it.ends.1)])
                .marked(Mark::Bars),
        );
    }
    Figure {
        title: format!("{}: return against speed", results.settings.common.env),
        notes: vec![
            "Greedy return, mean over seeds with its 95% interval, and frames a second of whole runs; to the upper right is better."
                .into(),
        ],
        columns: 1,
        panel_size: (860.0, 460.0),
        panels: vec![Panel::Chart(Chart::new(
            "",
            Axis::linear("frames/s"),
            Axis::linear("greedy return"),
            series,
        ))],
    }
}

fn place(name: String, point: &PointResult) -> Option<Placed> {
    let value = point.mean(Measure::Greedy)?;
    Some(Placed {
        name,
        speed: point.mean(Measure::FramesPerSecond)?.mean,
        value: value.mean,
        ends: value.ends.unwrap_or((value.mean, value.mean)),
    })
}

/// Those than which no other is faster and no worse, or better and no slower; the slowest first.
fn front(placed: &[Placed]) -> Vec<Placed> {
    let beaten = |it: &Placed| {
        placed.iter().any(|other| {
            other.speed >= it.speed
                && other.value >= it.value
                && (other.speed > it.speed || other.value > it.value)
        })
    };
    let mut front: Vec<_> = placed.iter().filter(|it| !beaten(it)).cloned().collect();
    front.sort_by(|a, b| a.speed.total_cmp(&b.speed));
    front
}

/// A point by its level, or by its agent where it is a base.
fn name(results: &Results, key: &str) -> String {
    let level = results.levels.iter().find(|it| it.point.key == key);
    match level {
        Some(of) if !of.point.sets.is_empty() => of.name(),
        _ => format!("{key} (base)"),
    }
}

/// Training return over seconds, a panel for each dial with its base.
pub(super) fn wall(results: &Results) -> anyhow::Result<Figure> {
    let mut panels = Vec::new();
    let mut dials: Vec<&str> = Vec::new();
    for of in &results.levels {
        if dials.contains(&of.dial.name.as_str()) {
            continue;
        }
        dials.push(&of.dial.name);
        let mut series = vec![curve(&of.dial.base, 0, &results.points[&of.base.key])?];
        let levels = results
            .levels
            .iter()
            .filter(|it| it.dial.name == of.dial.name);
        for (index, it) in levels.enumerate() {
            series.push(curve(&it.level, index + 1, &results.points[&it.point.key])?);
        }
        panels.push(Panel::Chart(Chart::new(
            &of.dial.name,
            Axis::linear("seconds"),
            Axis::linear("mean return"),
            series,
        )));
    }
    Ok(Figure {
        title: format!("{}: return against wall-clock time", results.settings.common.env),
        notes: vec![
            "Training return, mean of the last 100 episodes; mean and range over seeds. Every run has the same number of frames."
                .into(),
        ],
        columns: 3,
        panel_size: (330.0, 250.0),
        panels,
    })
}

fn curve(name: &str, index: usize, point: &PointResult) -> anyhow::Result<Series> {
    let mut each = Vec::new();
    for it in &point.seeds {
        each.push(Run::read(&it.ran.folder)?.values_over(Over::Seconds, "mean_return")?);
    }
    let curve = over_seeds(&each);
    Ok(Series::line(name, index, curve.points).banded(curve.band))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_front_has_what_no_other_beats() {
        let at = |name: &str, speed: f64, value: f64| Placed {
            name: name.into(),
            speed,
            value,
            ends: (value, value),
        };
        let all = [
            at("slow and good", 1.0, 9.0),
            at("slow and bad", 1.0, 2.0),
            at("fast and bad", 5.0, 3.0),
            at("between", 3.0, 5.0),
            at("beaten", 2.0, 4.9),
        ];
        let names: Vec<_> = front(&all).into_iter().map(|it| it.name).collect();
        assert_eq!(names, ["slow and good", "between", "fast and bad"]);
    }
}
