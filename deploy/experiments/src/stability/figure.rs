//! The figure: the worst error of each row as a share of what its routine promises.

use driml_figure::{Axis, Chart, Figure, GREY, Mark, Panel, Series};

use super::property::Row;

/// Where a row stands that had no error at all, which a logarithmic axis has no place for.
const NONE: f64 = 1e-6;
/// Where a row stands whose promise is broken by more than the axis has room for.
const MOST: f64 = 10.0;
/// So few that their names have room below a chart.
const ROUTINES_A_CHART: usize = 8;

/// Worst errors of rows with these inputs, `aside` of the place of their routine.
fn points(rows: &[Row], names: &[String], is_drawn: bool, aside: f64) -> Vec<(f64, f64)> {
    let some = rows.iter().filter(|it| it.is_drawn == is_drawn);
    let points = some.filter_map(|row| {
        let at = names.iter().position(|name| *name == row.routine)? as f64;
        let share = match row.seen.worst {
            _ if row.seen.cases == 0 => MOST,
            0.0 => 0.0,
            worst => worst / row.bound,
        };
        Some((at + aside, share.clamp(NONE, MOST)))
    });
    points.collect()
}

/// One chart over some of the routines.
fn chart(rows: &[Row], names: &[String]) -> Chart {
    let of = |is_drawn, aside| points(rows, names, is_drawn, aside);
    let ends = vec![(-0.5, 1.0), (names.len() as f64 - 0.5, 1.0)];
    let promise = Series::line("the promise", 0, ends).coloured(GREY);
    Chart::new(
        &format!("{} to {}", names[0], names[names.len() - 1]),
        Axis::names("", names),
        Axis::log("worst error / promise").showing(&[NONE, MOST]),
        vec![
            promise.marked(Mark::Dashed),
            Series::line("listed extremes", 0, of(false, -0.1)).marked(Mark::Rings),
            Series::line("drawn inputs", 1, of(true, 0.1)).marked(Mark::Rings),
        ],
    )
}

/// All rows, over several charts.
pub(super) fn figure(rows: &[Row], cases: &str) -> Figure {
    let mut names: Vec<String> = rows.iter().map(|row| row.routine.into()).collect();
    names.dedup();
    let charts = names.chunks(ROUTINES_A_CHART);
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
        assert_eq!(points(&rows, &names, false, 0.0), [(0.0, 0.5), (0.0, MOST)]);
        assert_eq!(points(&rows, &names, true, 0.0), [(0.0, NONE)]);
    }
}
