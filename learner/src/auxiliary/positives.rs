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

impl Positives {
    /// The numbers of later states per row that the replay server may serve.
    pub const fn served_counts(self) -> RangeInclusive<usize> {
        match self {
            Self::None | Self::OtherView => 0..=0,
            Self::One => 1..=1,
            Self::Several => 1..=usize::MAX,
        }
    }

    /// [`Positives::served_counts`] in words.
    pub const fn describe_served(self) -> &'static str {
        match self {
            Self::None | Self::OtherView => "no later state",
            Self::One => "one later state",
            Self::Several => "one or more later states",
        }
    }

    /// A value of `run.horizon` that serves such a number, as TOML.
    pub const fn example_horizon(self) -> &'static str {
        match self {
            Self::None | Self::OtherView => r#"{rule="none"}"#,
            Self::One => r#"{rule="fixed",k=1}"#,
            Self::Several => r#"{rule="all",k_max=5}"#,
        }
    }

    /// Whether a batch with `count` positives per row fits; `has_views` says whether the batch contains augmented s_t.
    pub const fn accepts(self, count: usize, has_views: bool) -> bool {
        match self {
            Self::None => true,
            Self::One => count == 1,
            Self::Several => count >= 1,
            Self::OtherView => count == 1 && has_views,
        }
    }

    /// The requirement of [`Positives::accepts`] in words.
    pub const fn describe_accepted(self) -> &'static str {
        match self {
            Self::None => "any number",
            Self::One => "one",
            Self::Several => "one or more",
            Self::OtherView => "two views of each state",
        }
    }
}
