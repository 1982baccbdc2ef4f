//! A property: a routine of the product, the inputs for which it promises something, the promises and what tries them; and what was
//! seen of each promise at each kind of extreme.
//! It computes nothing itself: a check brings errors and the input that gave them.

use std::{fmt::Arguments, ops::Range};

use driml_machine::error::Interrupted;
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

use super::settings::Settings;
use crate::progress::Progress;

/// A row of the table of properties.
pub(super) struct Property {
    pub(super) routine: &'static str,
    /// The inputs, as the routine's own documentation has them.
    pub(super) range: &'static str,
    /// Each in words, with what an error is a share of, and the largest error that it allows; 0 where it allows none.
    pub(super) promises: &'static [(&'static str, f64)],
    /// Runs the routine beside its reference on as many inputs as the settings want.
    pub(super) check: fn(&mut Cases<'_>) -> anyhow::Result<()>,
}

impl Property {
    /// A promise at one kind of extreme, before the first case.
    fn row(&self, promise: usize, extreme: &str) -> Row {
        let (words, bound) = self.promises[promise];
        Row {
            routine: self.routine.to_owned(),
            range: self.range.to_owned(),
            extreme: extreme.to_owned(),
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
            .map(|(promise, _)| self.row(promise, "none was tried"))
            .collect()
    }
}

/// One promise at one kind of extreme.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct Row {
    pub(super) routine: String,
    pub(super) range: String,
    pub(super) extreme: String,
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

/// What a check draws its cases with, and reports them to.
pub(super) struct Cases<'a> {
    pub(super) settings: &'a Settings,
    /// The generator of inputs, and of nothing else.
    pub(super) rng: ChaCha8Rng,
    pub(super) property: &'static Property,
    pub(super) progress: &'a mut Progress,
    /// What was seen so far.
    pub(super) rows: Vec<Row>,
}

impl Cases<'_> {
    /// The rows of all cases.
    pub(super) fn run(mut self) -> anyhow::Result<Vec<Row>> {
        (self.property.check)(&mut self)?;
        self.progress.advance(1)?;
        Ok(self.rows)
    }

    /// Numbers of `share` of the draws, and of at least 8.
    pub(super) fn draws(&self, share: f64) -> Range<u64> {
        0..(self.settings.draws as f64 * share).ceil().max(8.0) as u64
    }

    /// Counts a case with its errors, in the order and the units of the promises; NaN is the largest, none says nothing.
    pub(super) fn see<E: Into<Option<f64>>, const N: usize>(
        &mut self,
        extreme: &str,
        input: Arguments<'_>,
        errors: [E; N],
    ) -> Result<(), Interrupted> {
        for (promise, error) in errors.into_iter().enumerate() {
            let Some(error) = error.into() else { continue };
            let row = self.row(promise, extreme);
            row.cases += 1;
            // The least of a number and NaN is the number.
            let error = error.abs().min(f64::MAX);
            if error > row.worst {
                (row.worst, row.input) = (error, input.to_string());
            }
        }
        self.pause()
    }

    /// Where an interrupt ends a check that has long to go until its next case.
    pub(super) fn pause(&mut self) -> Result<(), Interrupted> {
        self.progress.advance(0)
    }

    fn row(&mut self, promise: usize, extreme: &str) -> &mut Row {
        let words = self.property.promises[promise].0;
        let mut rows = self.rows.iter();
        let found = rows.position(|it| it.is_beside(words, extreme));
        let at = found.unwrap_or_else(|| {
            self.rows.push(self.property.row(promise, extreme));
            self.rows.len() - 1
        });
        &mut self.rows[at]
    }
}

/// The error of a promise that allows none.
pub(super) fn broken(is_kept: bool) -> f64 {
    f64::from(u8::from(!is_kept))
}

#[cfg(test)]
mod tests {
    use driml_launch::interrupts::Interrupts;
    use rand::SeedableRng;

    use super::*;

    static HALVING: Property = Property {
        routine: "halving",
        range: "any",
        promises: &[("error", 0.5), ("other bits", 0.0), ("untried", 0.0)],
        check: |cases| {
            for (input, error) in [(1, 0.25), (2, -0.375), (3, 0.125)] {
                cases.see("small", format_args!("{input}"), [error, broken(true)])?;
            }
            cases.see("large", format_args!("4"), [Some(f64::NAN), None])?;
            Ok(())
        },
    };

    #[test]
    fn a_row_keeps_its_worst_case_and_no_number_is_worst_of_all() {
        let cases = Cases {
            settings: &toml::from_str(include_str!("smoke.toml")).unwrap(),
            rng: ChaCha8Rng::seed_from_u64(1),
            property: &HALVING,
            progress: &mut Progress::new(1, Interrupts::default()),
            rows: Vec::new(),
        };
        let mut rows = cases.run().unwrap();
        rows.extend(HALVING.untried(&rows));
        let seen = |row: &Row| (row.cases, row.worst, row.input.clone(), row.is_kept());
        let expected = [
            (3, 0.375, "2".to_owned(), true),
            (3, 0.0, String::new(), true),
            (1, f64::MAX, "4".to_owned(), false),
            (0, 0.0, String::new(), false),
        ];
        assert_eq!(rows.iter().map(seen).collect::<Vec<_>>(), expected);
        let mut both = rows.clone();
        both[0].worst = 0.125;
        merge(&mut both, rows);
        assert_eq!((both.len(), both[0].cases, both[0].worst), (4, 6, 0.375));
    }
}
