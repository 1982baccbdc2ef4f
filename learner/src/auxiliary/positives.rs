//! What an auxiliary loss compares a state with: none, one or several later states, or another view of the state itself.
//! This decides what batches, the replay's horizon and the augmentation have to be.

use std::ops::RangeInclusive;

/// What an auxiliary loss compares s_t with.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Positives {
    /// Nothing: the update uses no states beyond those of C51.
    None,
    /// One later state per row, s_{t+k}.
    One,
    /// One or more later states per row.
    Several,
    /// Another augmentation of s_t; no later state is served.
    OtherView,
}

/// The later states that a loss needs the replay server to serve.
#[derive(Clone, Debug)]
pub struct ServedStates {
    /// The numbers per row that fit.
    pub counts: RangeInclusive<usize>,
    /// These numbers in words.
    pub words: &'static str,
    /// A value of `run.horizon` that serves such a number, as TOML.
    pub example_horizon: &'static str,
}

impl Positives {
    /// The later states per row that the replay server may serve.
    pub fn served(self) -> ServedStates {
        let (counts, words, example_horizon) = match self {
            Self::None | Self::OtherView => (0..=0, "no later state", r#"{rule="none"}"#),
            Self::One => (1..=1, "one later state", r#"{rule="fixed",k=1}"#),
            Self::Several => {
                let any = 1..=usize::MAX;
                (any, "one or more later states", r#"{rule="all",k_max=5}"#)
            }
        };
        ServedStates {
            counts,
            words,
            example_horizon,
        }
    }

    /// Checks that a batch with `count` positives per row fits; `has_views` says whether the batch contains augmented s_t.
    ///
    /// # Errors
    /// The requirement in words.
    pub fn check_batch(self, count: usize, has_views: bool) -> Result<(), &'static str> {
        let (fits, needed) = match self {
            Self::None => (true, "any number"),
            Self::One => (count == 1, "one"),
            Self::Several => (count >= 1, "one or more"),
            Self::OtherView => (count == 1 && has_views, "two views of each state"),
        };
        fits.then_some(()).ok_or(needed)
    }
}
