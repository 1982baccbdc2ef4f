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
    /// Most moves of a target network towards one that stands still; a tau that needs more is left out.
    pub(super) follow_moves: u64,
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
    pub(super) range: &'static str,
    /// Each in words, with what an error is a share of, and the largest error that it allows; 0 where it allows none.
    pub(super) promises: &'static [(&'static str, f64)],
    /// Kinds of extremes in words, how many cases of each, and what runs the routine beside its reference in one case.
    pub(super) extremes: &'static [(&'static str, Inputs, Check)],
}

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
    /// Runs all checks; what they saw of each promise at each kind of extreme.
    pub(super) fn rows(
        &self,
        settings: &Settings,
        rng: ChaCha8Rng,
        progress: &mut Progress,
    ) -> anyhow::Result<Vec<Row>> {
        let mut cases = Cases {
            settings,
            rng,
            progress,
            taken: None,
            lists: 0,
            rows: Vec::new(),
        };
        let mut all = Vec::new();
        for &(extreme, inputs, check) in self.extremes {
            let steps = settings.adam_steps.to_string();
            let updates = settings.affinity_updates.to_string();
            let extreme = extreme
                .replace("{adam_steps}", &steps)
                .replace("{affinity_updates}", &updates);
            let rows = self.promises.iter().map(|&(promise, bound)| Row {
                routine: self.routine.to_owned(),
                range: self.range.to_owned(),
                extreme: extreme.clone(),
                is_drawn: matches!(inputs, Drawn(_)),
                promise: promise.to_owned(),
                bound,
                ..Row::default()
            });
            cases.rows = rows.collect();
            cases.run(inputs, check)?;
            all.append(&mut cases.rows);
        }
        cases.progress.advance(1)?;
        Ok(all)
    }
}

/// One promise at one kind of extreme.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
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

    fn see(&mut self, input: Arguments<'_>, error: f64) {
        self.cases += 1;
        // The least of a number and NaN is the number.
        let error = error.abs().min(f64::MAX);
        if error > self.worst {
            (self.worst, self.input) = (error, input.to_string());
        }
    }
}

/// Adds what another seed saw of the same property.
pub(super) fn merge(rows: &mut Vec<Row>, others: Vec<Row>) {
    if rows.is_empty() {
        *rows = others;
        return;
    }
    assert_eq!(rows.len(), others.len(), "each seed has all rows");
    for (row, other) in rows.iter_mut().zip(others) {
        row.cases += other.cases;
        if other.worst > row.worst {
            (row.worst, row.input) = (other.worst, other.input);
        }
    }
}

/// Of a property's rows those with a case, and one, which is not kept, of each promise that has none at any extreme.
pub(super) fn tried(rows: Vec<Row>) -> Vec<Row> {
    let (mut tried, untried): (Vec<_>, Vec<_>) = rows.into_iter().partition(|row| row.cases > 0);
    for mut row in untried {
        if tried.iter().all(|it| it.promise != row.promise) {
            (row.extreme, row.is_drawn) = ("none was tried".into(), false);
            tried.push(row);
        }
    }
    tried
}

/// What a check takes the inputs of a case from, and reports its errors to.
pub(super) struct Cases<'a> {
    pub(super) settings: &'a Settings,
    /// The generator of inputs, and of nothing else.
    pub(super) rng: ChaCha8Rng,
    progress: &'a mut Progress,
    /// Which item of each list the case takes, and of how many; none where they are drawn.
    taken: Option<Vec<(usize, usize)>>,
    /// The lists that the case has taken an item of.
    lists: usize,
    /// One for each promise, at the extreme that is tried.
    rows: Vec<Row>,
}

impl Cases<'_> {
    /// How many cases this share of the draws is.
    pub(super) fn draws(&self, share: f64) -> u64 {
        (self.settings.draws as f64 * share).ceil().max(8.0) as u64
    }

    fn run(&mut self, inputs: Inputs, check: Check) -> anyhow::Result<()> {
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
        Ok(())
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
            if let Some(error) = error.into() {
                self.rows[promise].see(input, error);
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
        self.rows[promise].see(input, if is_kept { 0.0 } else { 1.0 });
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
        let rows = tried(HALVING.rows(&settings, rng, progress).unwrap());
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
