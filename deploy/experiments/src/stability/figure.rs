//! The figure: the worst error of each row as a share of the promised bound.

use driml_figure::{Axis, Chart, Figure, GREY, Mark, Panel, Series};

use super::property::Row;

/// The drawn value of a row without any error, because 0 has no place on a logarithmic axis.
const LOW: f64 = 1e-6;
/// The largest drawn value, for rows whose error exceeds the bound by more.
const HIGH: f64 = 10.0;
/// The number of routines in a chart, so that their names fit below it.
const ROUTINES_PER_CHART: usize = 8;

/// Returns the worst errors of the rows with drawn or listed inputs, each at x = index of its routine + `x_offset`.
fn points(rows: &[Row], names: &[String], is_drawn: bool, x_offset: f64) -> Vec<(f64, f64)> {
    let some = rows.iter().filter(|it| it.is_drawn == is_drawn);
    let points = some.filter_map(|row| {
        let at = names.iter().position(|name| *name == row.routine)? as f64;
        let share = match row.tally.worst {
            _ if row.tally.cases == 0 => HIGH,
            0.0 => 0.0,
            worst => worst / row.bound,
        };
        Some((at + x_offset, share.clamp(LOW, HIGH)))
    });
    points.collect()
}

/// Draws one chart for some of the routines.
fn chart(rows: &[Row], names: &[String]) -> Chart {
    let series_points = |is_drawn, x_offset| points(rows, names, is_drawn, x_offset);
    let ends = vec![(-0.5, 1.0), (names.len() as f64 - 0.5, 1.0)];
    let promise = Series::line("the promise", 0, ends).with_colour(GREY);
    Chart::new(
        &format!("{} to {}", names[0], names[names.len() - 1]),
        Axis::names("", names),
        Axis::log("worst error / promise").covering(&[LOW, HIGH]),
        vec![
            promise.with_mark(Mark::Dashed),
            Series::line("listed extremes", 0, series_points(false, -0.1)).with_mark(Mark::Rings),
            Series::line("drawn inputs", 1, series_points(true, 0.1)).with_mark(Mark::Rings),
        ],
    )
}

/// Draws all rows, split into several charts.
pub(super) fn figure(rows: &[Row], cases: &str) -> Figure {
    let mut names: Vec<String> = rows.iter().map(|row| row.routine.into()).collect();
    names.dedup();
    let charts = names.chunks(ROUTINES_PER_CHART);
    let charts = charts.map(|some| Panel::Chart(chart(rows, some)));
    Figure {
        title: "The worst error of each routine, beside what it promises".into(),
        notes: vec![
            format!("{cases} cases. A ring a row; above the dashed line a promise is broken."),
            "At the bottom: no error at all, as where a promise allows none.".into(),
        ],
        columns: 1,
        panel_size: (1_000.0, 270.0),
        panels: charts.collect(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::stability::tests::row;

    #[test]
    fn inputs_have_their_side_and_a_promise_that_was_not_tried_is_not_kept() {
        let row = |is_drawn, cases, worst| Row {
            is_drawn,
            ..row(cases, worst, "")
        };
        let rows = [row(false, 1, 0.25), row(true, 1, 0.0), row(false, 0, 0.0)];
        let names = ["halving".to_owned()];
        assert_eq!(points(&rows, &names, false, 0.0), [(0.0, 0.5), (0.0, HIGH)]);
        assert_eq!(points(&rows, &names, true, 0.0), [(0.0, LOW)]);
    }
}
