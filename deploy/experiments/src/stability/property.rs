//! A property: a routine of the product, the inputs for which it promises something, the promises and what tries them; and what was
//! seen of each promise at each kind of extreme.
//! It computes nothing itself: a check brings the errors of one case and the input that gave them.

use std::fmt::Arguments;

use driml_machine::error::Interrupted;
use serde::{Deserialize, Serialize};

use crate::progress::Progress;

// What a check is written in.
pub(super) use super::edges::*;
pub(super) use Inputs::{Drawn, Listed};
pub(super) use rand::Rng;
pub(super) use rand_chacha::ChaCha8Rng;

/// How much is tried: a table of `config.toml`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Settings {
    /// Seeds 1 to this. No piece depends on it, so that more can be added later.
    #[serde(skip_serializing)]
    pub(super) seeds: u32,
    /// Random inputs of a quick routine; slower ones take a share of it.
    pub(super) draws: u64,
    /// Steps of the longest run of Adam.
    pub(super) adam_steps: u64,
    /// Updates of the learned affinity.
    pub(super) affinity_updates: u64,
    /// Draws from each law that is tested.
    pub(super) law_draws: u64,
    /// Random probabilities for which every value that can be drawn is drawn.
    pub(super) whole_draws: u64,
}

/// A row of the table of properties.
pub(super) struct Property {
    pub(super) routine: &'static str,
    /// The inputs, as the routine's own documentation has them.
    range: &'static str,
    /// Each in words, with what an error is a share of, and the largest error that it allows; 0 where it allows none.
    promises: Vec<(&'static str, f64)>,
    checks: Vec<(Inputs, Box<Check>)>,
    /// Each promise at each kind of extreme.
    pub(super) rows: Vec<Row>,
}

/// Where the inputs of a check come from.
#[derive(Clone, Copy)]
pub(super) enum Inputs {
    /// Every combination of what the check lists.
    Listed,
    /// The generator, in this share of the draws, 8 or more.
    Drawn(f64),
}

/// Runs the routine beside its reference in one case.
type Check = dyn Fn(&mut Cases<'_>) -> anyhow::Result<()>;

impl Property {
    pub(super) const fn new(routine: &'static str, range: &'static str) -> Self {
        Self {
            routine,
            range,
            promises: Vec::new(),
            checks: Vec::new(),
            rows: Vec::new(),
        }
    }

    pub(super) fn promise(mut self, promise: &'static str, bound: f64) -> Self {
        self.promises.push((promise, bound));
        self
    }

    /// Has all promises tried on these inputs, a kind of extremes in words.
    pub(super) fn on(
        mut self,
        extreme: &str,
        inputs: Inputs,
        check: impl Fn(&mut Cases<'_>) -> anyhow::Result<()> + 'static,
    ) -> Self {
        self.checks.push((inputs, Box::new(check)));
        for &(promise, bound) in &self.promises {
            self.rows.push(Row {
                routine: self.routine,
                range: self.range,
                extreme: extreme.to_owned(),
                is_drawn: matches!(inputs, Drawn(_)),
                promise,
                bound,
                seen: Seen::default(),
            });
        }
        self
    }

    /// Runs all checks; what they saw, in the order of the rows.
    pub(super) fn run(
        &self,
        settings: &Settings,
        rng: ChaCha8Rng,
        progress: &mut Progress,
    ) -> anyhow::Result<Vec<Seen>> {
        let mut cases = Cases {
            settings,
            rng,
            progress,
            rest: None,
            combinations: 1,
            seen: Vec::new(),
        };
        let mut all = Vec::new();
        for (inputs, check) in &self.checks {
            cases.seen = vec![Seen::default(); self.promises.len()];
            let (is_listed, mut count) = match *inputs {
                Listed => (true, 1),
                Drawn(share) => (false, cases.draws(share)),
            };
            let mut case = 0;
            while case < count {
                cases.rest = is_listed.then_some(case);
                cases.combinations = 1;
                match check(&mut cases) {
                    // Breaks the first promise, and the error stands for its input.
                    Err(e) if !e.is::<Interrupted>() => {
                        cases.see(format_args!("{e:#}"), [f64::NAN])?;
                    }
                    done => done?,
                }
                // How many lists there are is known once a case has taken an item of each.
                count = count.max(cases.combinations);
                case += 1;
            }
            all.append(&mut cases.seen);
        }
        Ok(all)
    }

    /// Adds what one seed saw.
    pub(super) fn add(&mut self, seen: Vec<Seen>) {
        assert_eq!(self.rows.len(), seen.len(), "each seed has all rows");
        for (row, seen) in self.rows.iter_mut().zip(seen) {
            row.seen.add(seen.cases, seen.worst, || seen.input);
        }
    }

    /// The rows with a case, and one, which is not kept, of each promise that has none at any extreme.
    pub(super) fn tried(self) -> Vec<Row> {
        let rows = self.rows.into_iter();
        let (mut tried, untried): (Vec<_>, Vec<_>) = rows.partition(|row| row.seen.cases > 0);
        for mut row in untried {
            if tried.iter().all(|it| it.promise != row.promise) {
                (row.extreme, row.is_drawn) = ("none was tried".into(), false);
                tried.push(row);
            }
        }
        tried
    }
}

/// One promise at one kind of extreme.
#[derive(Clone, Debug, Default)]
pub(super) struct Row {
    pub(super) routine: &'static str,
    pub(super) range: &'static str,
    pub(super) extreme: String,
    /// Whether its inputs are of the generator, and not listed.
    pub(super) is_drawn: bool,
    pub(super) promise: &'static str,
    pub(super) bound: f64,
    pub(super) seen: Seen,
}

impl Row {
    pub(super) fn is_kept(&self) -> bool {
        self.seen.cases > 0 && self.seen.worst <= self.bound
    }
}

/// What was seen of a row.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub(super) struct Seen {
    pub(super) cases: u64,
    /// The largest error, in units of the bound's; the largest float where a result was not a number.
    pub(super) worst: f64,
    /// What gave it.
    pub(super) input: String,
}

impl Seen {
    fn add(&mut self, cases: u64, error: f64, input: impl FnOnce() -> String) {
        self.cases += cases;
        if error > self.worst {
            (self.worst, self.input) = (error, input());
        }
    }
}

/// What a check takes the inputs of a case from, and reports its errors to.
pub(super) struct Cases<'a> {
    pub(super) settings: &'a Settings,
    /// The generator of inputs, and of nothing else.
    pub(super) rng: ChaCha8Rng,
    progress: &'a mut Progress,
    /// The number of the combination of listed inputs, without the lists that an item was taken of; none where inputs are drawn.
    rest: Option<u64>,
    /// Of the lists that the case has taken an item of.
    combinations: u64,
    /// Of each promise, at the extreme that is tried.
    seen: Vec<Seen>,
}

impl Cases<'_> {
    /// How many cases this share of the draws is.
    pub(super) fn draws(&self, share: f64) -> u64 {
        (self.settings.draws as f64 * share).ceil().max(8.0) as u64
    }

    /// One of these: in turn where inputs are listed, beside every item of the other lists; else any.
    pub(super) fn each<T: Clone>(&mut self, items: &[T]) -> T {
        self.of(items, |rng| one_of(items, rng))
    }

    /// One of these where inputs are listed, as [`Cases::each`] takes it; else one that is drawn. A list is as long in each case.
    pub(super) fn of<T: Clone>(
        &mut self,
        items: &[T],
        draw: impl FnOnce(&mut ChaCha8Rng) -> T,
    ) -> T {
        let Some(rest) = &mut self.rest else {
            return draw(&mut self.rng);
        };
        let count = items.len() as u64;
        let at = *rest % count;
        *rest /= count;
        self.combinations *= count;
        items[at as usize].clone()
    }

    /// Counts errors of this case, in the order and the units of the promises; NaN is the largest, none says nothing.
    pub(super) fn see<E: Into<Option<f64>>, const N: usize>(
        &mut self,
        input: Arguments<'_>,
        errors: [E; N],
    ) -> anyhow::Result<()> {
        for (promise, error) in errors.into_iter().enumerate() {
            if let Some(error) = error.into() {
                // The least of a number and NaN is the number.
                let error = error.abs().min(f64::MAX);
                self.seen[promise].add(1, error, || input.to_string());
            }
        }
        self.pause()
    }

    /// Counts whether this case keeps a promise that allows no error.
    pub(super) fn keeps(
        &mut self,
        promise: usize,
        input: Arguments<'_>,
        is_kept: bool,
    ) -> anyhow::Result<()> {
        self.seen[promise].add(1, f64::from(!is_kept), || input.to_string());
        self.pause()
    }

    /// Where an interrupt ends a case that has long to go until it sees an error.
    pub(super) fn pause(&mut self) -> anyhow::Result<()> {
        Ok(self.progress.advance(0)?)
    }
}

#[cfg(test)]
mod tests {
    use driml_protocol::GracefulShutdown;
    use rand::SeedableRng;

    use super::*;
    use crate::{
        flags,
        stability::{NAME, SETTINGS},
    };

    #[test]
    fn a_row_keeps_the_worst_of_all_combinations_and_no_number_is_worst_of_all() {
        let mut halving = Property::new("halving", "any")
            .promise("error", 310.0)
            .promise("other bits", 0.0)
            .promise("untried", 0.0)
            .on("listed", Listed, |cases| {
                let number = 100 * cases.each(&[1, 2, 3]) + 10 * cases.of(&[0, 1], |_| 9);
                cases.see(format_args!("{number}"), [-f64::from(number), 0.0])
            })
            .on("drawn", Drawn(0.1), |cases| {
                let number = cases.of(&[1000], |rng| rng.random_range(0..10));
                cases.see(format_args!("{number}"), [f64::from(number)])
            })
            .on("large", Listed, |cases| {
                cases.see(format_args!("4"), [Some(f64::NAN), None])
            })
            .on("failing", Listed, |_| anyhow::bail!("no memory"));
        let settings = flags::settings(NAME, SETTINGS, true);
        let progress = &mut Progress::new(1, GracefulShutdown::default());
        let rng = ChaCha8Rng::seed_from_u64(1);
        let seen = halving.run(&settings, rng, progress).unwrap();
        halving.add(seen.clone());
        halving.add(seen);
        let rows = halving.tried();
        let expected = [
            ("listed", 12, 310.0, "310", true),
            ("listed", 12, 0.0, "", true),
            ("drawn", 80, 9.0, "9", true),
            ("large", 2, f64::MAX, "4", false),
            ("failing", 2, f64::MAX, "no memory", false),
            ("none was tried", 0, 0.0, "", false),
        ];
        for (row, expected) in rows.iter().zip(expected) {
            let (extreme, seen) = (&*row.extreme, &row.seen);
            let found = (extreme, seen.cases, seen.worst, &*seen.input, row.is_kept());
            assert_eq!(found, expected);
            assert_eq!(row.is_drawn, row.extreme == "drawn");
        }
        assert_eq!(rows.len(), expected.len());
    }
}
