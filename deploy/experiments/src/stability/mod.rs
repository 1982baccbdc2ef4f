//! Every numeric routine at the extremes of its range: what it promises, and the worst that was found, beside its reference.
//! What is promised and tried stands in `checks`; the bounds are those of each routine of the product.

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

use self::{
    checks::TABLE,
    property::{Row, Settings},
};
use crate::{
    cache::{self, Session},
    flags::{self, ExperimentFlags},
};

const NAME: &str = "stability";
const SETTINGS: &str = include_str!("config.toml");
const COLUMNS: &str = "routine,range,extreme,cases,worst,promised,kept,promise,input";

/// Runs the experiment.
pub(super) fn run(args: &ExperimentFlags) -> anyhow::Result<()> {
    let mut settings: Settings = flags::settings(NAME, SETTINGS, args.smoke);
    settings.seeds = args.seeds.unwrap_or(settings.seeds);
    let table = || TABLE.into_iter().flatten();
    let units = table().count() as u64 * u64::from(settings.seeds);
    let mut session = Session::open(NAME, args, &settings, units, false)?;
    // What another build of the routines kept says nothing of these.
    let program = cache::program()?;
    let mut rows: Vec<Row> = Vec::new();
    for (at, property) in table().enumerate() {
        let mut of_property = Vec::new();
        for seed in 1..=settings.seeds {
            let name = property
                .routine
                .replace(|c: char| !c.is_alphanumeric(), "-");
            let key = format!("{at:02}-{name}-seed{seed}");
            let found = session.piece_of(&program, &key, 1, |progress| {
                let mut rng = ChaCha8Rng::seed_from_u64(seed.into());
                rng.set_stream(at as u64);
                property.rows(&settings, rng, progress)
            })?;
            property::merge(&mut of_property, found);
        }
        rows.extend(property::tried(of_property));
    }
    let promises = rows.iter().map(|row| {
        let of = (&row.routine, &row.range, &row.extreme, row.cases);
        let kept = if row.is_kept() { "yes" } else { "no" };
        let found = [number(row.worst), number(row.bound)];
        (of, found, kept, &row.promise, &row.input)
    });
    session.csv("promises", COLUMNS, promises)?;
    session.figure("worst", &figure::figure(&rows, &cases(&rows)))?;
    let page = session.folder().join("README.md");
    session.finish(include_str!("page.md.j2"), values(&rows, &settings))?;
    let is_kept = rows.iter().all(Row::is_kept);
    ensure!(is_kept, "{} See {}", verdict(&rows), page.display());
    Ok(())
}

/// Two digits; what is not a number is the largest float.
fn number(value: f64) -> String {
    match value {
        0.0 => "0".to_owned(),
        f64::MAX => "not finite".to_owned(),
        value if (0.01..1000.0).contains(&value) => format!("{value:.2}"),
        value => format!("{value:.1e}"),
    }
}

fn cases(rows: &[Row]) -> String {
    HumanCount(rows.iter().map(|row| row.cases).sum()).to_string()
}

/// What came out, in a sentence.
fn verdict(rows: &[Row]) -> String {
    let kept = rows.iter().filter(|row| row.is_kept()).count();
    let (all, cases) = (rows.len(), cases(rows));
    format!("{kept} of {all} promises are kept, in {cases} cases.")
}

fn values(rows: &[Row], settings: &Settings) -> Value {
    let broken = rows.iter().filter(|row| !row.is_kept()).map(|row| {
        let (worst, bound) = (number(row.worst), number(row.bound));
        format!(
            "**Not kept**: {}, {}: {}: {worst}, promised {bound}; at {}.",
            row.routine, row.extreme, row.promise, row.input
        )
    });
    // Rows that allow an error, by how much of it is used.
    let share = |row: &Row| 100.0 * row.worst / row.bound;
    let mut close: Vec<&Row> = rows.iter().filter(|row| row.bound > 0.0).collect();
    close.sort_by(|a, b| share(b).total_cmp(&share(a)));
    let mut named = HashSet::new();
    close.retain(|row| named.insert(&row.routine));
    let nearest = close.iter().take(5);
    let nearest: Vec<_> = nearest
        .map(|row| format!("{} ({:.0}%)", row.routine, share(row)))
        .collect();
    context! {
        verdict => verdict(rows),
        broken => broken.collect::<Vec<_>>(),
        nearest => nearest.join(", "),
        processor => resources::processor(),
        kernels => Precision::ALL.map(describe_kernels).join("; "),
        draws => HumanCount(settings.draws).to_string(),
        seeds => settings.seeds,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn both_lengths_read() {
        for smoke in [false, true] {
            let settings: Settings = flags::settings(NAME, SETTINGS, smoke);
            assert!(settings.seeds > 0 && settings.draws > 0);
        }
    }

    #[test]
    fn the_page_and_the_verdict_name_what_is_broken() {
        let settings = flags::settings(NAME, SETTINGS, true);
        let page = |rows: &[Row]| {
            let values = values(rows, &settings);
            crate::page::page(include_str!("page.md.j2"), values, true, "1 s.")
        };
        let mut row = Row {
            routine: "halving".into(),
            extreme: "big".into(),
            promise: "error of |x|".into(),
            bound: 0.5,
            cases: 1,
            worst: 0.25,
            ..Row::default()
        };
        assert_eq!(
            verdict(&[row.clone()]),
            "1 of 1 promises are kept, in 1 cases."
        );
        let text = page(&[row.clone()]);
        assert!(!text.contains("Not kept"), "{text}");
        assert!(
            text.contains("Nearest to their promises: halving (50%)."),
            "{text}"
        );

        (row.worst, row.input) = (f64::MAX, "7e38".into());
        assert!(verdict(&[row.clone()]).starts_with("0 of 1 promises are kept"));
        let text = page(&[row]);
        let broken = "halving, big: error of |x|: not finite, promised 0.50; at 7e38.";
        assert!(text.contains(broken), "{text}");
    }

    #[test]
    fn numbers_are_short() {
        assert_eq!([0.25, 3.1e-8].map(number), ["0.25", "3.1e-8"]);
    }
}
