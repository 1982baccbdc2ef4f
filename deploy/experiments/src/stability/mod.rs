//! Checks every numeric routine at the extremes of its range: its promised error bounds, and the worst errors found against a reference.
//! `checks` has the promises and the inputs; most bounds are constants of the routines themselves. This module has the data, the figure
//! and the page.

mod checks;
mod edges;
mod property;

use std::collections::HashSet;

use anyhow::ensure;
use driml_figure::{Axis, Chart, Figure, GREY, Mark, Panel, Series};
use driml_machine::resources;
use driml_model::{Precision, describe_kernels};
use indicatif::HumanCount;
use minijinja::{Value, context};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use self::property::{Row, Settings};
use crate::{
    cache::Session,
    flags::{self, ExperimentFlags},
};

const SETTINGS: &str = include_str!("config.toml");
const COLUMNS: &str = "routine,range,extreme,cases,worst,promised,kept,promise,input";

pub(super) fn run(args: &ExperimentFlags) -> anyhow::Result<()> {
    let settings: Settings = flags::read_settings(SETTINGS, args);
    let table = checks::table(&settings);
    let units = table.len() as u64 * u64::from(settings.seeds);
    let mut session = Session::open("stability", args, &settings, units, false)?;
    let mut rows: Vec<Row> = Vec::new();
    for (at, property) in table.iter().enumerate() {
        let mut seeds = Vec::new();
        for seed in 1..=settings.seeds {
            let key = format!("{at:02}-{}-seed{seed}", property.routine);
            seeds.push(session.load_or_compute("", &key, 1, |progress| {
                let mut rng = ChaCha8Rng::seed_from_u64(seed.into());
                rng.set_stream(at as u64);
                property.run(&settings, rng, progress)
            })?);
        }
        rows.extend(property.rows(seeds));
    }
    let promises = rows.iter().map(|row| {
        let check = (row.routine, row.range, &row.extreme, row.tally.cases);
        let kept = if row.is_kept() { "yes" } else { "no" };
        let found = [format_number(row.tally.worst), format_number(row.bound)];
        (check, found, kept, row.promise, &row.tally.input)
    });
    session.write_csv("promises", COLUMNS, promises)?;
    session.save_figure("worst", &figure(&rows))?;
    let page = session.folder.join("README.md");
    session.write_page(include_str!("page.md.j2"), page_values(&rows, &settings))?;
    let is_kept = rows.iter().all(Row::is_kept);
    ensure!(is_kept, "{} See {}", verdict(&rows), page.display());
    Ok(())
}

/// Formats a number with two digits. The largest float stands for a result that is not finite.
fn format_number(value: f64) -> String {
    match value {
        0.0 => "0".to_owned(),
        f64::MAX => "not finite".to_owned(),
        value if (0.01..1000.0).contains(&value) => format!("{value:.2}"),
        value => format!("{value:.1e}"),
    }
}

fn case_count(rows: &[Row]) -> String {
    let cases: u64 = rows.iter().map(|row| row.tally.cases).sum();
    let noun = if cases == 1 { "case" } else { "cases" };
    format!("{} {noun}", HumanCount(cases))
}

fn verdict(rows: &[Row]) -> String {
    let kept = rows.iter().filter(|row| row.is_kept()).count();
    let (all, cases) = (rows.len(), case_count(rows));
    format!("{kept} of {all} promises are kept, in {cases}.")
}

fn page_values(rows: &[Row], settings: &Settings) -> Value {
    let broken = rows.iter().filter(|row| !row.is_kept()).map(|row| {
        let [worst, bound] = [row.tally.worst, row.bound].map(format_number);
        context! { row, worst, bound }
    });
    // Rows with a bound above 0, sorted by the share of the bound that is used.
    let share = |row: &Row| 100.0 * row.tally.worst / row.bound;
    let mut close: Vec<&Row> = rows.iter().filter(|row| row.bound > 0.0).collect();
    close.sort_by(|a, b| share(b).total_cmp(&share(a)));
    let mut named = HashSet::new();
    close.retain(|row| named.insert(row.routine));
    let nearest = close.iter().take(5);
    let nearest = nearest.map(|row| format!("{} ({:.0}%)", row.routine, share(row)));
    context! {
        verdict => verdict(rows),
        broken => broken.collect::<Vec<_>>(),
        nearest => nearest.collect::<Vec<_>>().join(", "),
        processor => resources::processor_name(),
        kernels => Precision::ALL.map(describe_kernels).join("; "),
        draws => HumanCount(settings.draws).to_string(),
        seeds => settings.seeds,
    }
}

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

fn figure(rows: &[Row]) -> Figure {
    let mut names: Vec<String> = rows.iter().map(|row| row.routine.into()).collect();
    names.dedup();
    let charts = names.chunks(ROUTINES_PER_CHART);
    let charts = charts.map(|some| Panel::Chart(chart(rows, some)));
    Figure {
        title: "The worst error of each routine, beside what it promises".into(),
        notes: vec![
            format!(
                "{}. A ring a row; above the dashed line a promise is broken.",
                case_count(rows)
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
    use super::{property::Tally, *};
    use crate::flags::tests::parse;

    fn row(cases: u64, worst: f64, input: &str) -> Row {
        Row {
            routine: "halving",
            extreme: "big".into(),
            promise: "error of |x|",
            bound: 0.5,
            tally: Tally {
                cases,
                worst,
                input: input.into(),
            },
            ..Row::default()
        }
    }

    #[test]
    fn the_page_and_the_verdict_name_what_is_broken() {
        let reported = |worst: f64, input: &str| {
            let rows = [row(1, worst, input)];
            let settings = flags::read_settings(SETTINGS, &parse("--smoke"));
            let values = page_values(&rows, &settings);
            let page = crate::page::render_page(include_str!("page.md.j2"), values, true, "1 s.");
            (verdict(&rows), page)
        };
        let (verdict, page) = reported(0.25, "");
        assert_eq!(verdict, "1 of 1 promises are kept, in 1 case.");
        assert!(!page.contains("Not kept"), "{page}");
        let nearest = "Nearest to their promises: halving (50%).";
        assert!(page.contains(nearest), "{page}");
        let (verdict, page) = reported(f64::MAX, "7e38");
        assert!(verdict.starts_with("0 of 1 promises are kept"));
        let broken = "halving, big: error of |x|: not finite, promised 0.50; at 7e38.";
        assert!(page.contains(broken), "{page}");
    }

    #[test]
    fn numbers_are_short() {
        assert_eq!([0.25, 3.1e-8].map(format_number), ["0.25", "3.1e-8"]);
    }
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
