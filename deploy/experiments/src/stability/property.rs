//! A property: a routine of the product, the inputs for which it promises something, the promises and what tries them; and what was
//! seen of each promise at each kind of extreme.
//! It computes nothing itself: a check brings the errors of one case and the input that gave them.

use std::fmt::Arguments;

use driml_machine::error::Interrupted;
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

use super::{edges::one_of, settings::Settings};
use crate::progress::Progress;

/// A row of the table of properties.
pub(super) struct Property {
    pub(super) routine: &'static str,
    /// The inputs, as the routine's own documentation has them.
    pub(super) range: &'static str,
    /// Each in words, with what an error is a share of, and the largest error that it allows; 0 where it allows none.
    pub(super) promises: &'static [(&'static str, f64)],
    /// Kinds of extremes in words, how many cases of each, and what runs the routine beside its reference in one case.
    pub(super) extremes: &'static [(&'static str, Inputs, Check)],
}

pub(super) use Inputs::{Drawn, Listed};

/// Where the inputs of a check come from.
#[derive(Clone, Copy)]
pub(super) enum Inputs {
    /// Every combination of what the check lists.
    Listed,
    /// The generator, in this share of the draws, 8 or more.
    Drawn(f64),
}

pub(super) type Check = fn(&mut Cases<'_>) -> anyhow::Result<()>;

impl Property {
    /// A promise at one kind of extreme, before the first case.
    fn row(&self, promise: usize, extreme: &str, is_drawn: bool) -> Row {
        let (words, bound) = self.promises[promise];
        Row {
            routine: self.routine.to_owned(),
            range: self.range.to_owned(),
            extreme: extreme.to_owned(),
            is_drawn,
            promise: words.to_owned(),
            bound,
            cases: 0,
            worst: 0.0,
            input: String::new(),
        }
    }

    /// Rows without a case, which are not kept, of the promises that these rows say nothing of.
    pub(super) fn untried(&self, rows: &[Row]) -> Vec<Row> {
        let promises = self.promises.iter().enumerate();
        let untried = promises.filter(|(_, it)| rows.iter().all(|row| row.promise != it.0));
        untried
            .map(|(promise, _)| self.row(promise, "none was tried", false))
            .collect()
    }
}

/// One promise at one kind of extreme.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct Row {
    pub(super) routine: String,
    pub(super) range: String,
    pub(super) extreme: String,
    /// Whether its inputs are of the generator, and not listed.
    pub(super) is_drawn: bool,
    pub(super) promise: String,
    pub(super) bound: f64,
    pub(super) cases: u64,
    /// The largest error seen, in units of the bound's; the largest float where a result was not a number.
    pub(super) worst: f64,
    /// What gave it.
    pub(super) input: String,
}

impl Row {
    pub(super) fn is_kept(&self) -> bool {
        self.cases > 0 && self.worst <= self.bound
    }

    fn is_beside(&self, promise: &str, extreme: &str) -> bool {
        self.extreme == extreme && self.promise == promise
    }
}

/// Adds what another seed saw of the same property.
pub(super) fn merge(rows: &mut Vec<Row>, others: Vec<Row>) {
    for other in others {
        let same = |row: &&mut Row| row.is_beside(&other.promise, &other.extreme);
        let Some(row) = rows.iter_mut().find(same) else {
            rows.push(other);
            continue;
        };
        row.cases += other.cases;
        if other.worst > row.worst {
            (row.worst, row.input) = (other.worst, other.input);
        }
    }
}

/// What a check takes the inputs of a case from, and reports its errors to.
pub(super) struct Cases<'a> {
    pub(super) settings: &'a Settings,
    /// The generator of inputs, and of nothing else.
    pub(super) rng: ChaCha8Rng,
    property: &'static Property,
    progress: &'a mut Progress,
    extreme: String,
    /// Which item of each list the case takes, and of how many; none where they are drawn.
    taken: Option<Vec<(usize, usize)>>,
    /// The lists that the case has taken an item of.
    lists: usize,
    rows: Vec<Row>,
}

impl<'a> Cases<'a> {
    pub(super) fn new(
        settings: &'a Settings,
        rng: ChaCha8Rng,
        property: &'static Property,
        progress: &'a mut Progress,
    ) -> Self {
        Self {
            settings,
            rng,
            property,
            progress,
            extreme: String::new(),
            taken: None,
            lists: 0,
            rows: Vec::new(),
        }
    }

    /// How many cases this share of the draws is.
    pub(super) fn draws(&self, share: f64) -> u64 {
        (self.settings.draws as f64 * share).ceil().max(8.0) as u64
    }

    /// The rows of all cases.
    pub(super) fn run(mut self) -> anyhow::Result<Vec<Row>> {
        for &(extreme, inputs, check) in self.property.extremes {
            let steps = self.settings.adam_steps.to_string();
            let updates = self.settings.affinity_updates.to_string();
            self.extreme = extreme
                .replace("{adam_steps}", &steps)
                .replace("{affinity_updates}", &updates);
            match inputs {
                Listed => {
                    self.taken = Some(Vec::new());
                    while self.taken.is_some() {
                        self.attempt(check)?;
                        self.combine_anew();
                    }
                }
                Drawn(share) => {
                    for _ in 0..self.draws(share) {
                        self.attempt(check)?;
                    }
                }
            }
        }
        self.progress.advance(1)?;
        Ok(self.rows)
    }

    /// Runs a case; one that fails breaks the first promise, and the error stands for its input.
    fn attempt(&mut self, check: Check) -> anyhow::Result<()> {
        match check(self) {
            Err(e) if !e.is::<Interrupted>() => self.see(format_args!("{e:#}"), [f64::NAN]),
            done => done,
        }
    }

    /// Goes to the next combination of listed inputs, the last list's item first; none is taken after the last.
    fn combine_anew(&mut self) {
        self.lists = 0;
        let mut taken = self.taken.take().unwrap_or_default();
        while let Some((at, count)) = taken.pop() {
            if at + 1 < count {
                taken.push((at + 1, count));
                self.taken = Some(taken);
                break;
            }
        }
    }

    /// One of these: in turn where inputs are listed, beside every item of the other lists; else any.
    pub(super) fn each<T: Clone>(&mut self, items: &[T]) -> T {
        self.of(items, |rng| one_of(items, rng))
    }

    /// One of these where inputs are listed, as [`Cases::each`] takes it; else one that is drawn.
    pub(super) fn of<T: Clone>(
        &mut self,
        items: &[T],
        draw: impl FnOnce(&mut ChaCha8Rng) -> T,
    ) -> T {
        let Some(taken) = &mut self.taken else {
            return draw(&mut self.rng);
        };
        if self.lists == taken.len() {
            taken.push((0, items.len()));
        }
        self.lists += 1;
        items[taken[self.lists - 1].0].clone()
    }

    /// Counts errors of this case, in the order and the units of the promises; NaN is the largest, none says nothing.
    pub(super) fn see<E: Into<Option<f64>>, const N: usize>(
        &mut self,
        input: Arguments<'_>,
        errors: [E; N],
    ) -> anyhow::Result<()> {
        for (promise, error) in errors.into_iter().enumerate() {
            let Some(error) = error.into() else { continue };
            let words = self.property.promises[promise].0;
            let mut rows = self.rows.iter();
            let found = rows.position(|it| it.is_beside(words, &self.extreme));
            let at = found.unwrap_or_else(|| {
                let row = self
                    .property
                    .row(promise, &self.extreme, self.taken.is_none());
                self.rows.push(row);
                self.rows.len() - 1
            });
            let row = &mut self.rows[at];
            row.cases += 1;
            // The least of a number and NaN is the number.
            let error = error.abs().min(f64::MAX);
            if error > row.worst {
                (row.worst, row.input) = (error, input.to_string());
            }
        }
        self.pause()
    }

    /// Counts whether this case keeps a promise, one of the first three, that allows no error.
    pub(super) fn keeps(
        &mut self,
        promise: usize,
        input: Arguments<'_>,
        is_kept: bool,
    ) -> anyhow::Result<()> {
        let mut errors = [None; 3];
        errors[promise] = Some(if is_kept { 0.0 } else { 1.0 });
        self.see(input, errors)
    }

    /// Where an interrupt ends a case that has long to go until it sees an error.
    pub(super) fn pause(&mut self) -> anyhow::Result<()> {
        Ok(self.progress.advance(0)?)
    }
}

#[cfg(test)]
mod tests {
    use driml_protocol::GracefulShutdown;
    use rand::{Rng, SeedableRng};

    use super::*;
    use crate::{
        flags,
        stability::{NAME, SETTINGS},
    };

    static HALVING: Property = Property {
        routine: "halving",
        range: "any",
        promises: &[("error", 320.0), ("other bits", 0.0), ("untried", 0.0)],
        extremes: &[
            ("listed", Listed, |cases| {
                // Which items there are may depend on what was taken before.
                let first = cases.each(&[1, 2, 3]);
                let second = cases.of(&[0, 1, 2][..first], |_| 9);
                let number = 100 * first + 10 * second;
                cases.see(format_args!("{number}"), [-(number as f64), 0.0])
            }),
            ("drawn", Drawn(0.1), |cases| {
                let number = cases.of(&[1000], |rng| rng.random_range(0..10));
                cases.see(format_args!("{number}"), [f64::from(number)])
            }),
            ("large", Listed, |cases| {
                cases.see(format_args!("4"), [Some(f64::NAN), None])
            }),
            ("failing", Listed, |_| anyhow::bail!("no memory")),
        ],
    };

    #[test]
    fn a_row_keeps_the_worst_of_all_combinations_and_no_number_is_worst_of_all() {
        let settings = flags::settings(NAME, SETTINGS, true);
        let progress = &mut Progress::new(1, GracefulShutdown::default());
        let rng = ChaCha8Rng::seed_from_u64(1);
        let cases = Cases::new(&settings, rng, &HALVING, progress);
        let mut rows = cases.run().unwrap();
        rows.extend(HALVING.untried(&rows));
        let seen = |row: &Row| (row.cases, row.worst, row.input.clone(), row.is_kept());
        assert_eq!(
            rows.iter().filter(|it| it.is_drawn).count(),
            1,
            "the third row"
        );
        let expected = [
            (6, 320.0, "320".to_owned(), true),
            (6, 0.0, String::new(), true),
            (40, 9.0, "9".to_owned(), true),
            (1, f64::MAX, "4".to_owned(), false),
            (1, f64::MAX, "no memory".to_owned(), false),
            (0, 0.0, String::new(), false),
        ];
        assert_eq!(rows.iter().map(seen).collect::<Vec<_>>(), expected);
        let mut both = rows.clone();
        both[0].worst = 160.0;
        merge(&mut both, rows);
        assert_eq!((both.len(), both[0].cases, both[0].worst), (6, 12, 320.0));
    }
}
