//! The figure: the worst error of each row as a share of what its routine promises.

use driml_figure::{Axis, Chart, Figure, GREY, Mark, Panel, Series};

use super::check::Row;

/// Where a row stands that had no error at all, which a logarithmic axis has no place for.
const NONE: f64 = 1e-6;
/// Where a row stands whose promise is broken by more than the axis has room for.
const MOST: f64 = 10.0;

/// The charts, each with the routine that it begins with.
const CHARTS: [(&str, &str); 4] = [
    ("Losses and clipping", "C51 projection"),
    ("Optimiser, products, weights", "Adam"),
    ("Affinity, sampling, replay", "affinity, exact"),
    ("Schedules, counters, worlds", "epsilon"),
];

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

/// The routines of each chart, beside its title.
fn charts(names: &[String]) -> impl Iterator<Item = (&'static str, &[String])> {
    let begin = |at: usize| {
        let first = CHARTS.get(at).map(|(_, first)| *first);
        let found = names.iter().position(|name| Some(name.as_str()) == first);
        found.unwrap_or(names.len())
    };
    let titles = CHARTS.iter().enumerate();
    titles.map(move |(at, (title, _))| {
        let some = names.get(begin(at)..begin(at + 1)).unwrap_or_default();
        (*title, some)
    })
}

/// All rows, over several charts so that the names have room.
pub(super) fn figure(rows: &[Row], cases: &str) -> Figure {
    let names = routines(rows);
    let charts = charts(&names).map(|(title, some)| Panel::Chart(chart(rows, some, title)));
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
        panels: charts.collect(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The routines of the page that is committed.
    #[test]
    fn every_routine_is_in_a_chart() {
        let table = include_str!("../../results/stability/promises.csv");
        let mut names: Vec<String> = Vec::new();
        for line in table.lines().skip(1) {
            let name = match line.strip_prefix('"') {
                Some(quoted) => quoted.split('"').next(),
                None => line.split(',').next(),
            };
            let name = name.unwrap().to_owned();
            if !names.contains(&name) {
                names.push(name);
            }
        }
        let drawn: Vec<String> = charts(&names).flat_map(|(_, some)| some.to_vec()).collect();
        assert_eq!(drawn, names);
        assert!(charts(&names).all(|(_, some)| !some.is_empty()));
    }
}
