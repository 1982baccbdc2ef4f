//! What an auxiliary loss compares a state with: later states, as many as it can use, or another view of the state itself.
//! How a batch, the replay's horizon and the augmentation must be follows from it.

use std::ops::RangeInclusive;

/// What an auxiliary loss compares s_t with.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Positives {
    /// Nothing: no state beyond those of C51 is looked at.
    None,
    /// One later state a row, s_{t+k}.
    One,
    /// One or more later states a row.
    Several,
    /// Another augmentation of s_t; no later state is served.
    OtherView,
}

impl Positives {
    /// Later states a row that the replay server may serve.
    pub const fn served(self) -> RangeInclusive<usize> {
        match self {
            Self::None | Self::OtherView => 0..=0,
            Self::One => 1..=1,
            Self::Several => 1..=usize::MAX,
        }
    }

    /// [`Positives::served`] in words.
    pub const fn describe_served(self) -> &'static str {
        match self {
            Self::None | Self::OtherView => "no later state",
            Self::One => "one later state",
            Self::Several => "one or more later states",
        }
    }

    /// A `run.horizon` that serves as many, as settings have it.
    pub const fn horizon(self) -> &'static str {
        match self {
            Self::None | Self::OtherView => r#"{rule="none"}"#,
            Self::One => r#"{rule="fixed",k=1}"#,
            Self::Several => r#"{rule="all",k_max=5}"#,
        }
    }

    /// Whether a batch with `count` positives a row will do; `views` says whether it holds s_t as the loss sees it.
    pub const fn fit(self, count: usize, views: bool) -> bool {
        match self {
            Self::None => true,
            Self::One => count == 1,
            Self::Several => count >= 1,
            Self::OtherView => count == 1 && views,
        }
    }

    /// What [`Positives::fit`] asks of a batch, in words.
    pub const fn describe_wanted(self) -> &'static str {
        match self {
            Self::None => "any number",
            Self::One => "one",
            Self::Several => "one or more",
            Self::OtherView => "two views of each state",
        }
    }
}
