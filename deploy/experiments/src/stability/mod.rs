//! Every numeric routine at the extremes of its range: what it promises, and the worst that was found, beside float64.
//! What is tried and against what stands in `routines`; what is promised stands with each routine of the product.

mod check;
mod edges;
mod figure;
mod routines;
mod settings;
mod small;

use anyhow::ensure;
use driml_machine::resources;
use driml_model::{Precision, kernels_in_words};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

use self::{
    check::{Context, Refusal, Row},
    routines::{MENU, refused},
    settings::Settings,
};
use crate::{
    cache::{self, Session},
    flags::{self, ExperimentFlags, this_command},
    page::{Page, Table, Values},
};

const NAME: &str = "stability";

/// What was found.
struct Results {
    settings: Settings,
    rows: Vec<Row>,
    refusals: Vec<Refusal>,
    machine: MachineNote,
}

/// Where it was found.
#[derive(Serialize, Deserialize)]
struct MachineNote {
    processor: String,
    kernels: String,
}

impl MachineNote {
    fn this() -> Self {
        let each = Precision::ALL.map(kernels_in_words);
        Self {
            processor: resources::processor(),
            kernels: each.join("; "),
        }
    }
}

impl Results {
    fn broken(&self) -> Vec<&Row> {
        self.rows.iter().filter(|row| !row.is_kept()).collect()
    }

    fn taken(&self) -> Vec<&Refusal> {
        self.refusals.iter().filter(|it| !it.is_by_name()).collect()
    }

    fn cases(&self) -> u64 {
        self.rows.iter().map(|row| row.cases).sum()
    }
}

/// Runs the experiment.
pub(super) fn run(args: &ExperimentFlags) -> anyhow::Result<()> {
    let mut settings: Settings = flags::settings(
        NAME,
        include_str!("config.toml"),
        include_str!("smoke.toml"),
        args,
    );
    settings.seeds = args.seeds.unwrap_or(settings.seeds);
    let each: u64 = MENU.iter().map(|(_, units, _)| units).sum();
    let units = each * u64::from(settings.seeds) + 1;
    let mut session = Session::open(NAME, args, &settings, units)?;
    // What another build of the routines kept says nothing of these.
    let program = cache::program()?;
    let mut rows: Vec<Row> = Vec::new();
    for (at, (family, units, check)) in MENU.into_iter().enumerate() {
        let mut of_family: Vec<Row> = Vec::new();
        for seed in 1..=settings.seeds {
            let key = format!("{family}-seed{seed}");
            let found: Vec<Row> = session.piece_of(&program, &key, units, |progress| {
                let mut rng = ChaCha8Rng::seed_from_u64(seed.into());
                rng.set_stream(at as u64);
                let found = check(&mut Context {
                    settings: &settings,
                    rng,
                    progress,
                })?;
                progress.advance(units)?;
                Ok(found)
            })?;
            if of_family.is_empty() {
                of_family = found;
            } else {
                let pairs = of_family.iter_mut().zip(&found);
                pairs.for_each(|(row, other)| row.merge(other));
            }
        }
        rows.extend(of_family);
    }
    let (refusals, machine) = session.piece_of(&program, "refused", 1, |progress| {
        progress.advance(1)?;
        Ok((refused::check()?, MachineNote::this()))
    })?;
    let results = Results {
        settings,
        rows,
        refusals,
        machine,
    };
    write_data(&session, &results)?;
    let cases = thousands(results.cases());
    session.figure("worst", &figure::figure(&results.rows, &cases))?;
    let command = this_command();
    let page = session.folder().join("README.md");
    session.finish(&page_of(&results, &command, args.smoke))?;
    let verdict = verdict(&results);
    let is_kept = results.broken().is_empty() && results.taken().is_empty();
    ensure!(is_kept, "{verdict} See {}", page.display());
    Ok(())
}

fn write_data(session: &Session, results: &Results) -> anyhow::Result<()> {
    let header = [
        "routine", "range", "extreme", "cases", "worst", "promised", "kept", "promise", "input",
    ];
    let rows = results.rows.iter().map(|row| {
        vec![
            row.routine.clone(),
            row.range.clone(),
            row.extreme.clone(),
            row.cases.to_string(),
            number(row.worst),
            number(row.bound),
            yes(row.is_kept()).to_owned(),
            row.promise.clone(),
            row.input.clone(),
        ]
    });
    session.csv("promises", &Table::new(&header, rows))?;
    let header = ["value", "refused_by_name", "message"];
    let rows = results.refusals.iter().map(|it| {
        let said = it.said.clone().unwrap_or_default();
        vec![it.value.clone(), yes(it.is_by_name()).to_owned(), said]
    });
    session.csv("refused", &Table::new(&header, rows))
}

const fn yes(truth: bool) -> &'static str {
    if truth { "yes" } else { "no" }
}

/// Two digits; what was no number at all says so.
fn number(value: f64) -> String {
    match value {
        0.0 => "0".to_owned(),
        f64::MAX => "not finite".to_owned(),
        value if (0.01..1000.0).contains(&value) => format!("{value:.2}"),
        value => format!("{value:.1e}"),
    }
}

fn thousands(count: u64) -> String {
    let digits = count.to_string();
    let groups: Vec<&str> = digits
        .as_bytes()
        .rchunks(3)
        .rev()
        .filter_map(|group| std::str::from_utf8(group).ok())
        .collect();
    groups.join(",")
}

/// Text as a cell of a table, whose columns a bar or a new line would end.
fn cell(text: &str) -> String {
    text.replace('|', "\\|").replace('\n', " ")
}

/// What came out, in a sentence.
fn verdict(results: &Results) -> String {
    let (rows, broken, taken) = (results.rows.len(), results.broken(), results.taken());
    match (broken.len(), taken.len()) {
        (0, 0) => format!(
            "All {rows} promises are kept, in {} cases.",
            thousands(results.cases())
        ),
        (broken, taken) => format!(
            "{broken} of {rows} promises are not kept, and {taken} of {} values out of range are not refused by name.",
            results.refusals.len()
        ),
    }
}

fn page_of(results: &Results, command: &str, smoke: bool) -> Page {
    let (broken, taken) = (results.broken(), results.taken());
    let broken: Vec<String> = broken
        .iter()
        .map(|row| {
            let (worst, bound) = (number(row.worst), number(row.bound));
            format!(
                "**Not kept**: {}, {}: {} is {worst}, promised {bound}; at {}.",
                row.routine, row.extreme, row.promise, row.input
            )
        })
        .chain(taken.iter().map(|it| {
            let said = it.said.as_deref().unwrap_or("nothing: it was taken");
            format!(
                "**Not refused by name**: {}. What was said: {said}.",
                it.value
            )
        }))
        .collect();
    let count = results.refusals.len();
    let refusals = format!(
        "{} of {count} values out of range are refused by name.",
        count - taken.len()
    );
    // Rows that allow an error, by how much of it is used.
    let mut close: Vec<&Row> = results.rows.iter().filter(|row| row.bound > 0.0).collect();
    close.sort_by(|a, b| (b.worst / b.bound).total_cmp(&(a.worst / a.bound)));
    let mut nearest: Vec<String> = Vec::new();
    for row in close {
        let named = nearest.iter().any(|it| it.starts_with(&row.routine));
        if !named && nearest.len() < 5 {
            nearest.push(format!(
                "{} ({:.0}%)",
                row.routine,
                100.0 * row.worst / row.bound
            ));
        }
    }
    let mut before: Option<&Row> = None;
    let rows = results.rows.iter().map(|row| {
        let of_routine = before.filter(|before| before.routine == row.routine);
        let name = match of_routine {
            Some(_) => String::new(),
            None => format!("**{}**: {}", row.routine, row.range),
        };
        let extreme = match of_routine {
            Some(before) if before.extreme == row.extreme => "the same",
            _ => &row.extreme,
        };
        before = Some(row);
        let kept = if row.is_kept() { "yes" } else { "**no**" };
        vec![
            name,
            cell(extreme),
            thousands(row.cases),
            cell(&row.promise),
            number(row.worst),
            number(row.bound),
            kept.to_owned(),
        ]
    });
    let header = [
        "routine: range",
        "extreme",
        "cases",
        "promise",
        "worst",
        "promised",
        "kept",
    ];
    let rows = Table {
        header: header.map(str::to_owned).into(),
        rows: rows.collect(),
    };
    let refused = results.refusals.iter().map(|it| {
        let said = it.said.as_deref().unwrap_or("**taken**");
        let mark = if it.is_by_name() {
            ""
        } else {
            "**not by name** "
        };
        vec![format!("`{}`", it.value), format!("{mark}{}", cell(said))]
    });
    let refused = Table {
        header: ["value", "what is said"].map(str::to_owned).into(),
        rows: refused.collect(),
    };
    let mut values = Values::default();
    values
        .set("verdict", verdict(results))
        .set("broken", broken)
        .set("refusals", refusals)
        .set(
            "nearest",
            format!("Nearest to their promises: {}.", nearest.join(", ")),
        )
        .set(
            "machine",
            format!("Processor: {}.", results.machine.processor),
        )
        .set("kernels", &results.machine.kernels)
        .set("draws", thousands(results.settings.draws))
        .set("seeds", results.settings.seeds)
        .set("rows", rows)
        .set("refused", refused)
        .set("all_refused", taken.is_empty());
    Page::new(include_str!("page.md"), values, command, smoke)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn both_lengths_read() {
        for text in [include_str!("config.toml"), include_str!("smoke.toml")] {
            let settings: Settings = toml::from_str(text).unwrap();
            assert!(settings.seeds > 0 && settings.draws > 0);
        }
    }

    fn results(rows: Vec<Row>, refusals: Vec<Refusal>) -> Results {
        Results {
            settings: toml::from_str(include_str!("smoke.toml")).unwrap(),
            rows,
            refusals,
            machine: MachineNote {
                processor: "a processor".into(),
                kernels: "plain code".into(),
            },
        }
    }

    #[test]
    fn what_is_broken_is_said() {
        let routine = check::Routine {
            name: "halving",
            range: "any",
        };
        let mut row = Row::new(routine, "big", "error of |x|", 0.5);
        row.see(0.25, || "3".into());
        let refusal = |said: Option<&str>| Refusal {
            name: "size".into(),
            value: "size = 9".into(),
            said: said.map(str::to_owned),
        };
        let good = results(
            vec![row.clone()],
            vec![refusal(Some("size = 9 is too large"))],
        );
        assert_eq!(verdict(&good), "All 1 promises are kept, in 1 cases.");
        let text = page_of(&good, "driml experiment stability", true).text(1.0, 1);
        assert!(
            !text.contains("Not kept") && text.contains("1 of 1 values"),
            "{text}"
        );
        assert!(
            text.contains("| big | 1 | error of \\|x\\| | 0.25 | 0.50 | yes |"),
            "{text}"
        );
        assert!(
            text.contains("Nearest to their promises: halving (50%)."),
            "{text}"
        );

        row.see(f64::INFINITY, || "7e38".into());
        let bad = results(vec![row], vec![refusal(None), refusal(Some("no"))]);
        assert!(verdict(&bad).starts_with("1 of 1 promises are not kept, and 2 of 2 values"));
        let text = page_of(&bad, "driml experiment stability", true).text(1.0, 1);
        for part in [
            "**Not kept**: halving, big: error of |x| is not finite, promised 0.50; at 7e38.",
            "**Not refused by name**: size = 9. What was said: nothing: it was taken.",
            "**not by name** no",
        ] {
            assert!(text.contains(part), "{part}\n{text}");
        }
    }

    #[test]
    fn numbers_are_short() {
        assert_eq!(number(0.25), "0.25");
        assert_eq!(number(3.1e-8), "3.1e-8");
        assert_eq!(
            (thousands(7), thousands(1_234_567)),
            ("7".into(), "1,234,567".into())
        );
    }
}
