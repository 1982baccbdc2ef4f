//! The figure: the worst error of each row as a share of what its routine promises.

use driml_figure::{Axis, Chart, Figure, GREY, Mark, Panel, Series};

use super::check::Row;

/// Where a row stands that had no error at all, which a logarithmic axis has no place for.
const NONE: f64 = 1e-6;
/// Where a row stands whose promise is broken by more than the axis has room for.
const MOST: f64 = 10.0;

/// The routines in their order, each once.
pub(super) fn routines(rows: &[Row]) -> Vec<String> {
    let mut names: Vec<String> = Vec::new();
    for row in rows {
        if !names.contains(&row.routine) {
            names.push(row.routine.clone());
        }
    }
    names
}

/// Worst error over promise; 0 and more for a promise that allows no error.
fn share(row: &Row) -> f64 {
    if row.worst == 0.0 {
        0.0
    } else {
        row.worst / row.bound
    }
}

/// One chart over some of the routines.
fn chart(rows: &[Row], names: &[String], title: &str) -> Chart {
    let at = |row: &Row| names.iter().position(|name| *name == row.routine);
    let of = |drawn: bool, aside: f64| -> Vec<(f64, f64)> {
        let some = rows.iter().filter(|row| {
            let extreme = &row.extreme;
            (extreme.starts_with("drawn") || extreme.ends_with(", drawn")) == drawn
        });
        let points =
            some.filter_map(|row| Some((at(row)? as f64 + aside, share(row).clamp(NONE, MOST))));
        points.collect()
    };
    let ends = vec![(-0.5, 1.0), (names.len() as f64 - 0.5, 1.0)];
    Chart::new(
        title,
        Axis::names("", names),
        Axis::log("worst error / promise").showing(&[NONE, MOST]),
        vec![
            Series::line("the promise", 0, ends)
                .coloured(GREY)
                .marked(Mark::Dashed),
            Series::line("listed extremes", 0, of(false, -0.1)).marked(Mark::Rings),
            Series::line("drawn inputs", 1, of(true, 0.1)).marked(Mark::Rings),
        ],
    )
}

/// All rows, over three charts so that the names have room.
pub(super) fn figure(rows: &[Row], cases: &str) -> Figure {
    let names = routines(rows);
    let third = names.len().div_ceil(3);
    let (first, rest) = names.split_at(third.min(names.len()));
    let (second, last) = rest.split_at(third.min(rest.len()));
    Figure {
        title: "The worst error of each routine, beside what it promises".into(),
        notes: vec![
            format!(
                "{cases} cases against float64. One ring a row of the table; above the dashed line a promise is broken."
            ),
            "At the bottom: no error at all, as where a promise allows none.".into(),
        ],
        columns: 1,
        panel_size: (1_000.0, 270.0),
        panels: vec![
            Panel::Chart(chart(rows, first, "Losses and clipping")),
            Panel::Chart(chart(rows, second, "Optimiser, products, weights")),
            Panel::Chart(chart(rows, last, "Sampling, schedules, worlds")),
        ],
    }
}
