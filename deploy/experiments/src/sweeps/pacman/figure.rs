//! Draws Fig. 3, up to the episodes and frames of the settings.

use driml_figure::{Axis, Chart, Figure, GREY, Mark, Panel, Series};
use driml_protocol::RETURNS_MAX;

use super::results::{LOSSES, Results};
use crate::{
    plot::{Band, combine_seeds, smooth},
    stats::Spread,
};

/// The share of a run over which the drawn loss is averaged.
const SMOOTHED_SHARE: f64 = 0.1;

/// Draws the DIM losses by epsilon, and the returns under one lethal ghost after another.
pub(super) fn figure(results: &Results) -> Figure {
    let settings = &results.settings;
    let mut panels = Vec::new();
    for (column, what) in LOSSES {
        let mut series = Vec::new();
        for (index, &epsilon) in settings.predictability.epsilons.iter().enumerate() {
            let window = settings.predictability.frames as f64 * SMOOTHED_SHARE;
            let each = results.losses(column, epsilon);
            let each: Vec<_> = each.map(|it| smooth(&it.points, window)).collect();
            let curve = combine_seeds(&each, Band::Range);
            series.push(curve.series(&format!("epsilon {epsilon}"), index));
        }
        let title = format!("(a) DIM loss, {what} features");
        let (x, y) = (Axis::linear("frames"), Axis::log("InfoNCE [nats]"));
        panels.push(Panel::Chart(Chart::new(&title, x, y, series)));
    }
    let titles = [
        "(b) One lethal ghost after another",
        "(c) The same with Ising noise in the walls",
    ];
    for (part, title) in titles.into_iter().enumerate() {
        let (x, y) = (Axis::linear("episodes"), Axis::linear("mean return"));
        let series = task_series(results, part);
        panels.push(Panel::Chart(Chart::new(title, x, y, series)));
    }
    Figure {
        title: "Ms. PacMan: what DIM finds, and what it is good for".into(),
        notes: vec![format!(
            "(a) Mean over a tenth of the run; mean and range over seeds. (b, c) Training return, mean of the last {RETURNS_MAX} \
             episodes; mean and range over seeds; vertical lines: another ghost becomes the lethal one; dashed: where {} stood at the \
             end of each task.",
            settings.agents.first().map_or("", String::as_str)
        )],
        columns: 2,
        panel_size: (430.0, 320.0),
        panels,
    }
}

fn task_series(results: &Results, part: usize) -> Vec<Series> {
    let continual = results.settings.continual(part);
    let mut series = Vec::new();
    let points = results.traces[part].iter().flat_map(|it| &it.points);
    let length = continual.episodes_per_task as f64;
    if let Some(Spread { min, max, .. }) = Spread::of(points.map(|point| point.1)) {
        for task in 1..continual.tasks {
            let x = length * task as f64;
            let line = Series::line("", 0, vec![(x, min), (x, max)]);
            series.push(line.with_colour(GREY).with_mark(Mark::Line));
        }
    }
    for (index, agent) in results.settings.agents.iter().enumerate() {
        let traces = || results.traces(part, agent);
        let each: Vec<_> = traces().map(|trace| trace.points.clone()).collect();
        let curve = combine_seeds(&each, Band::Range);
        series.push(curve.series(agent, index));
        let tasks = if index == 0 { continual.tasks } else { 0 };
        for task in 0..tasks {
            let ends = traces().filter_map(|trace| trace.tasks[task as usize]);
            if let Some(end) = Spread::of(ends.map(|it| it.0)) {
                let x = length * task as f64;
                let line = vec![(x, end.mean), (x + length, end.mean)];
                series.push(Series::line("", 0, line).with_mark(Mark::Dashed));
            }
        }
    }
    series
}
