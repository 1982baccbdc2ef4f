//! A row of the page: one routine at one kind of extreme, what it promises there, and the worst that was seen.
//! It computes nothing itself: routine and reference are brought to it as an error and the input that gave it.

use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

use super::settings::Settings;
use crate::progress::Progress;

/// A routine of the product, and the inputs for which it makes its promises.
#[derive(Clone, Copy, Debug)]
pub(super) struct Routine {
    pub(super) name: &'static str,
    /// As its own documentation has it.
    pub(super) range: &'static str,
}

/// One routine at one kind of extreme.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct Row {
    pub(super) routine: String,
    pub(super) range: String,
    pub(super) extreme: String,
    /// In words, with what an error is a share of.
    pub(super) promise: String,
    /// The largest error that the promise allows; 0 where it allows none.
    pub(super) bound: f64,
    pub(super) cases: u64,
    /// The largest error seen, in units of the bound's; the largest float where a result was no number.
    pub(super) worst: f64,
    /// What gave it.
    pub(super) input: String,
}

impl Row {
    /// Before the first case. `promise` says of what the error is a share.
    pub(super) fn new(routine: Routine, extreme: &str, promise: &str, bound: f64) -> Self {
        Self {
            routine: routine.name.to_owned(),
            range: routine.range.to_owned(),
            extreme: extreme.to_owned(),
            promise: promise.to_owned(),
            bound,
            cases: 0,
            worst: 0.0,
            input: String::new(),
        }
    }

    /// Counts a case with this error, in units of the bound's; NaN is the largest.
    pub(super) fn see(&mut self, error: f64, input: impl FnOnce() -> String) {
        self.cases += 1;
        let error = if error.is_nan() {
            f64::MAX
        } else {
            error.abs()
        };
        if error > self.worst {
            self.worst = error.min(f64::MAX);
            self.input = input();
        }
    }

    /// Counts a case of a promise that is kept or not.
    pub(super) fn must(&mut self, truth: bool, input: impl FnOnce() -> String) {
        self.see(if truth { 0.0 } else { 1.0 }, input);
    }

    /// Whether the promise was kept in every case, of which there was one.
    pub(super) fn is_kept(&self) -> bool {
        self.cases > 0 && self.worst <= self.bound
    }

    /// The same row of another seed.
    pub(super) fn merge(&mut self, other: &Self) {
        self.cases += other.cases;
        if other.worst > self.worst {
            (self.worst, self.input) = (other.worst, other.input.clone());
        }
    }
}

/// A value that is out of range, and what was said of it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct Refusal {
    /// The value, by the name that the refusal must have.
    pub(super) name: String,
    pub(super) value: String,
    /// The whole message; none where the value was taken.
    pub(super) said: Option<String>,
}

impl Refusal {
    /// Whether it was refused, by name.
    pub(super) fn is_by_name(&self) -> bool {
        self.said
            .as_ref()
            .is_some_and(|said| said.contains(&self.name))
    }
}

/// What a group of rows is made with.
pub(super) struct Context<'a> {
    pub(super) settings: &'a Settings,
    /// The generator of its inputs, and of nothing else.
    pub(super) rng: ChaCha8Rng,
    pub(super) progress: &'a mut Progress,
}

impl Context<'_> {
    /// Runs `one` with the numbers of `share` of the draws, and at least 8; ends between two where an interrupt asks to.
    pub(super) fn draw(
        &mut self,
        share: f64,
        mut one: impl FnMut(u64, &mut ChaCha8Rng) -> anyhow::Result<()>,
    ) -> anyhow::Result<()> {
        let draws = (self.settings.draws as f64 * share).ceil().max(8.0) as u64;
        for number in 0..draws {
            one(number, &mut self.rng)?;
            if number % 64 == 0 {
                self.progress.advance(0)?;
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_row_keeps_its_worst_case_and_no_number_is_worst_of_all() {
        let routine = Routine {
            name: "halving",
            range: "any",
        };
        let mut row = Row::new(routine, "big", "error", 0.5);
        assert!(!row.is_kept(), "nothing was tried");
        row.see(0.25, || "a".into());
        row.see(-0.375, || "b".into());
        row.see(0.125, || "c".into());
        assert_eq!((row.cases, row.worst, row.input.as_str()), (3, 0.375, "b"));
        assert!(row.is_kept());
        let mut bad = row.clone();
        bad.see(f64::NAN, || "d".into());
        assert!(!bad.is_kept() && bad.input == "d");
        row.merge(&bad);
        assert!(!row.is_kept() && row.cases == 7);
    }
}
