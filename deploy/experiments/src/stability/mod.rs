//! Checks every numeric routine at the extremes of its range: its promised error bounds, and the worst errors found against a reference.
//! `checks` has the promises and the inputs; most bounds are constants of the routines themselves.

mod checks;
mod edges;
mod figure;
mod property;

use std::collections::HashSet;

use anyhow::ensure;
use driml_machine::resources;
use driml_model::{Precision, describe_kernels};
use indicatif::HumanCount;
use minijinja::{Value, context};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use self::property::{Row, Settings};
use crate::{
    cache::{self, Session},
    flags::{self, ExperimentFlags},
};

const NAME: &str = "stability";
const SETTINGS: &str = include_str!("config.toml");
const COLUMNS: &str = "routine,range,extreme,cases,worst,promised,kept,promise,input";

/// Runs the experiment.
pub(super) fn run(args: &ExperimentFlags) -> anyhow::Result<()> {
    let settings: Settings = flags::read_settings(NAME, SETTINGS, args);
    let table = checks::table(&settings);
    let units = table.len() as u64 * u64::from(settings.seeds);
    let mut session = Session::open(NAME, args, &settings, units, false)?;
    // Pieces of another build of the program are not valid for its routines.
    let program = cache::program_id()?;
    let mut rows: Vec<Row> = Vec::new();
    for (at, mut property) in table.into_iter().enumerate() {
        let routine = property.routine;
        let name = routine.replace(|c: char| !c.is_alphanumeric(), "-");
        for seed in 1..=settings.seeds {
            let key = format!("{at:02}-{name}-seed{seed}");
            let tallies = session.load_or_make(&program, &key, 1, |progress| {
                let mut rng = ChaCha8Rng::seed_from_u64(seed.into());
                rng.set_stream(at as u64);
                property.run(&settings, rng, progress)
            })?;
            property.add_seed(tallies);
        }
        rows.extend(property.into_tried_rows());
    }
    let promises = rows.iter().map(|row| {
        let check = (row.routine, row.range, &row.extreme, row.tally.cases);
        let kept = if row.is_kept() { "yes" } else { "no" };
        let found = [format_number(row.tally.worst), format_number(row.bound)];
        (check, found, kept, row.promise, &row.tally.input)
    });
    session.write_csv("promises", COLUMNS, promises)?;
    session.save_figure("worst", &figure::figure(&rows, &case_count(&rows)))?;
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
    HumanCount(rows.iter().map(|row| row.tally.cases).sum()).to_string()
}

/// Returns the outcome as a sentence.
fn verdict(rows: &[Row]) -> String {
    let kept = rows.iter().filter(|row| row.is_kept()).count();
    let (all, cases) = (rows.len(), case_count(rows));
    format!("{kept} of {all} promises are kept, in {cases} cases.")
}

fn page_values(rows: &[Row], settings: &Settings) -> Value {
    let broken = rows.iter().filter(|row| !row.is_kept()).map(|row| {
        let (worst, bound) = (format_number(row.tally.worst), format_number(row.bound));
        let (routine, extreme, promise) = (row.routine, &row.extreme, row.promise);
        let input = &row.tally.input;
        format!(
            "**Not kept**: {routine}, {extreme}: {promise}: {worst}, promised {bound}; at {input}."
        )
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

#[cfg(test)]
mod tests {
    use super::{property::Tally, *};
    use crate::flags::tests::length;

    /// Creates a row with these results.
    pub(super) fn row(cases: u64, worst: f64, input: &str) -> Row {
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
            let values = page_values(&rows, &flags::read_settings(NAME, SETTINGS, &length(true)));
            let page = crate::page::render_page(include_str!("page.md.j2"), values, true, "1 s.");
            (verdict(&rows), page)
        };
        let (verdict, page) = reported(0.25, "");
        assert_eq!(verdict, "1 of 1 promises are kept, in 1 cases.");
        assert!(!page.contains("Not kept"), "{page}");
        let nearest = "Nearest to their promises: halving (50%).";
        assert!(page.contains(nearest), "{page}");
        let (verdict, page) = reported(f64::MAX, "7e38");
        assert!(verdict.starts_with("0 of 1 promises are kept"));
        let broken = "halving, big: error of |x|: not finite, promised 0.50; at 7e38.";
        assert!(page.contains(broken), "{page}");
    }

    #[test]
    fn both_lengths_read() {
        for smoke in [false, true] {
            let settings: Settings = flags::read_settings(NAME, SETTINGS, &length(smoke));
            assert!(settings.seeds > 0 && settings.draws > 0);
        }
    }

    #[test]
    fn numbers_are_short() {
        assert_eq!([0.25, 3.1e-8].map(format_number), ["0.25", "3.1e-8"]);
    }
}
