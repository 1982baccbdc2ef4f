//! A property: a routine of the product, the range of its inputs, its promises, the checks that try them, and what was seen of each
//! promise at each kind of extreme.
//! A property does no numerics: a check reports the errors of one case, with the input that gave them.

use std::fmt::Arguments;

use driml_machine::error::Interrupted;
use serde::{Deserialize, Serialize};

use crate::progress::Progress;

// The names that checks need.
pub(super) use super::edges::*;
pub(super) use Inputs::{Drawn, Listed};
pub(super) use rand::Rng;
pub(super) use rand_chacha::ChaCha8Rng;

/// How much is tried. A table of `config.toml`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Settings {
    /// The number of seeds, 1 to this. No piece depends on it, so that more seeds can be added later.
    #[serde(skip_serializing)]
    pub(super) seeds: u32,
    /// The base number of random inputs. Each check uses a share or a multiple of it.
    pub(super) draws: u64,
    /// The number of steps of the longest run of Adam.
    pub(super) adam_steps: u64,
    /// The number of updates of the learned affinity.
    pub(super) affinity_updates: u64,
    /// The number of draws from each tested distribution.
    pub(super) law_draws: u64,
    /// The number of random probabilities for which every possible draw is tried.
    pub(super) whole_draws: u64,
}

/// A routine with its promises and checks, in the table of properties.
pub(super) struct Property {
    pub(super) routine: &'static str,
    /// The range of inputs, as the routine documents it.
    range: &'static str,
    /// Each promise in words, including the unit of its error, and the largest allowed error; 0 if none is allowed.
    promises: Vec<(&'static str, f64)>,
    /// Each check with the kind of extreme that its inputs have.
    checks: Vec<(String, Inputs, Box<Check>)>,
}

/// The source of a check's inputs.
#[derive(Clone, Copy)]
pub(super) enum Inputs {
    /// Every combination of the values that the check lists.
    Listed,
    /// Random inputs: this share of `Settings::draws`, but at least 8.
    Drawn(f64),
}

/// A function that compares the routine with its reference in one case.
type Check = dyn Fn(&mut Cases<'_>) -> anyhow::Result<()>;

impl Property {
    pub(super) const fn new(routine: &'static str, range: &'static str) -> Self {
        Self {
            routine,
            range,
            promises: Vec::new(),
            checks: Vec::new(),
        }
    }

    pub(super) fn promise(mut self, promise: &'static str, bound: f64) -> Self {
        self.promises.push((promise, bound));
        self
    }

    /// Adds a check that tries all promises on these inputs. `extreme` describes the kind of inputs.
    pub(super) fn check(
        mut self,
        extreme: &str,
        inputs: Inputs,
        check: impl Fn(&mut Cases<'_>) -> anyhow::Result<()> + 'static,
    ) -> Self {
        self.checks
            .push((extreme.to_owned(), inputs, Box::new(check)));
        self
    }

    /// Runs all checks, and returns what they saw of each promise, one check after the other.
    pub(super) fn run(
        &self,
        settings: &Settings,
        rng: ChaCha8Rng,
        progress: &mut Progress,
    ) -> anyhow::Result<Vec<Tally>> {
        let mut cases = Cases {
            settings,
            rng,
            progress,
            listed_index: None,
            combinations: 1,
            tallies: Vec::new(),
        };
        let mut all = Vec::new();
        for (_, inputs, check) in &self.checks {
            cases.tallies = vec![Tally::default(); self.promises.len()];
            let (is_listed, mut count) = match *inputs {
                Listed => (true, 1),
                Drawn(share) => (false, cases.draw_count(share)),
            };
            let mut case = 0;
            while case < count {
                cases.listed_index = is_listed.then_some(case);
                cases.combinations = 1;
                match check(&mut cases) {
                    // An error breaks the first promise. Its message is shown as the input.
                    Err(e) if !e.is::<Interrupted>() => {
                        cases.record_errors(format_args!("{e:#}"), [f64::NAN])?;
                    }
                    done => done?,
                }
                // The number of combinations is known once a case has taken an item of each list.
                count = count.max(cases.combinations);
                case += 1;
            }
            all.append(&mut cases.tallies);
        }
        Ok(all)
    }

    /// Returns a row for each promise at each kind of extreme of which some seed has cases. For a promise without any case it adds one row,
    /// which counts as not kept.
    pub(super) fn rows(&self, seeds: Vec<Vec<Tally>>) -> Vec<Row> {
        let row = |extreme: &str, is_drawn, (promise, bound)| Row {
            routine: self.routine,
            range: self.range,
            extreme: extreme.to_owned(),
            is_drawn,
            promise,
            bound,
            tally: Tally::default(),
        };
        let mut rows = Vec::new();
        for (extreme, inputs, _) in &self.checks {
            let is_drawn = matches!(inputs, Drawn(_));
            rows.extend(self.promises.iter().map(|&it| row(extreme, is_drawn, it)));
        }
        for tallies in seeds {
            assert_eq!(tallies.len(), rows.len(), "each seed has all rows");
            for (row, tally) in rows.iter_mut().zip(tallies) {
                row.tally.add(tally.cases, tally.worst, || tally.input);
            }
        }
        rows.retain(|row| row.tally.cases > 0);
        for &promise in &self.promises {
            if rows.iter().all(|it| it.promise != promise.0) {
                rows.push(row("none was tried", false, promise));
            }
        }
        rows
    }
}

/// The result of one promise at one kind of extreme.
#[derive(Clone, Debug, Default, Serialize)]
pub(super) struct Row {
    pub(super) routine: &'static str,
    pub(super) range: &'static str,
    pub(super) extreme: String,
    /// Whether the inputs are random, not listed.
    pub(super) is_drawn: bool,
    pub(super) promise: &'static str,
    pub(super) bound: f64,
    pub(super) tally: Tally,
}

impl Row {
    pub(super) fn is_kept(&self) -> bool {
        self.tally.cases > 0 && self.tally.worst <= self.bound
    }
}

/// The cases of a row and the worst of them.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub(super) struct Tally {
    pub(super) cases: u64,
    /// The largest error, in the unit of the bound; the largest float if a result was NaN.
    pub(super) worst: f64,
    /// The input that gave the largest error.
    pub(super) input: String,
}

impl Tally {
    fn add(&mut self, cases: u64, error: f64, input: impl FnOnce() -> String) {
        self.cases += cases;
        if error > self.worst {
            (self.worst, self.input) = (error, input());
        }
    }
}

/// Gives a check the inputs of a case, and collects its errors.
pub(super) struct Cases<'a> {
    pub(super) settings: &'a Settings,
    /// The random generator of the inputs. It has no other use.
    pub(super) rng: ChaCha8Rng,
    progress: &'a mut Progress,
    /// The index of the combination of listed inputs, divided by the lengths of the lists used so far; `None` if inputs are drawn.
    listed_index: Option<u64>,
    /// The number of combinations of the lists that this case has used so far.
    combinations: u64,
    /// What was seen of each promise at the current extreme.
    tallies: Vec<Tally>,
}

impl Cases<'_> {
    /// Returns the number of cases in this share of the draws, at least 8.
    pub(super) fn draw_count(&self, share: f64) -> u64 {
        (self.settings.draws as f64 * share).ceil().max(8.0) as u64
    }

    /// Returns one of `items`. Listed inputs go through all combinations with the items of other lists; else the item is drawn.
    pub(super) fn one_of<T: Clone>(&mut self, items: &[T]) -> T {
        self.listed_or(items, |rng| one_of(items, rng))
    }

    /// Returns one of `items` like [`Cases::one_of`] if inputs are listed, else calls `draw`. A list has the same length in every case.
    pub(super) fn listed_or<T: Clone>(
        &mut self,
        items: &[T],
        draw: impl FnOnce(&mut ChaCha8Rng) -> T,
    ) -> T {
        let Some(listed_index) = &mut self.listed_index else {
            return draw(&mut self.rng);
        };
        let count = items.len() as u64;
        let at = *listed_index % count;
        *listed_index /= count;
        self.combinations *= count;
        items[at as usize].clone()
    }

    /// Counts the errors of this case, in the order and units of the promises. NaN counts as the largest error; `None` is not counted.
    pub(super) fn record_errors<E: Into<Option<f64>>, const N: usize>(
        &mut self,
        input: Arguments<'_>,
        errors: [E; N],
    ) -> anyhow::Result<()> {
        for (promise, error) in errors.into_iter().enumerate() {
            if let Some(error) = error.into() {
                // The minimum of a number and NaN is the number.
                let error = error.abs().min(f64::MAX);
                self.tallies[promise].add(1, error, || input.to_string());
            }
        }
        self.check_interrupt()
    }

    /// Returns an error if the user has interrupted. A long case calls this before it has an error to report.
    pub(super) fn check_interrupt(&mut self) -> anyhow::Result<()> {
        Ok(self.progress.advance(0)?)
    }
}

#[cfg(test)]
mod tests {
    use driml_protocol::GracefulShutdown;
    use rand::SeedableRng;

    use super::*;
    use crate::{
        flags::{self, tests::parse},
        stability::SETTINGS,
    };

    #[test]
    fn a_row_keeps_the_worst_of_all_combinations_and_no_number_is_worst_of_all() {
        let halving = Property::new("halving", "any")
            .promise("error", 310.0)
            .promise("other bits", 0.0)
            .promise("untried", 0.0)
            .check("listed", Listed, |cases| {
                let number = 100 * cases.one_of(&[1, 2, 3]) + 10 * cases.listed_or(&[0, 1], |_| 9);
                cases.record_errors(format_args!("{number}"), [-f64::from(number), 0.0])
            })
            .check("drawn", Drawn(0.1), |cases| {
                let number = cases.listed_or(&[1000], |rng| rng.random_range(0..10));
                cases.record_errors(format_args!("{number}"), [f64::from(number)])
            })
            .check("large", Listed, |cases| {
                cases.record_errors(format_args!("4"), [Some(f64::NAN), None])
            })
            .check("failing", Listed, |_| anyhow::bail!("no memory"));
        let settings = flags::read_settings(SETTINGS, &parse("--smoke"));
        let progress = &mut Progress::new(1, GracefulShutdown::default());
        let rng = ChaCha8Rng::seed_from_u64(1);
        let tallies = halving.run(&settings, rng, progress).unwrap();
        let rows = halving.rows(vec![tallies.clone(), tallies]);
        let expected = [
            ("listed", 12, 310.0, "310", true),
            ("listed", 12, 0.0, "", true),
            ("drawn", 80, 9.0, "9", true),
            ("large", 2, f64::MAX, "4", false),
            ("failing", 2, f64::MAX, "no memory", false),
            ("none was tried", 0, 0.0, "", false),
        ];
        for (row, expected) in rows.iter().zip(expected) {
            let (extreme, t) = (&*row.extreme, &row.tally);
            let found = (extreme, t.cases, t.worst, &*t.input, row.is_kept());
            assert_eq!(found, expected);
            assert_eq!(row.is_drawn, row.extreme == "drawn");
        }
        assert_eq!(rows.len(), expected.len());
    }
}
