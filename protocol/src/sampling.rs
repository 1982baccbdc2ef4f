//! By which rule the replay draws the rows of a batch: the menu, and what the learner has to know of it.
//! How rows are drawn is the replay server's, how they are weighted the learner's.

use serde::{Deserialize, Serialize};

use crate::config::{ConfigError, check};

/// By which rule the replay draws the rows of a batch: `replay.sampling`.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "rule", rename_all = "kebab-case", deny_unknown_fields)]
pub enum Sampling {
    /// Each transition that can be an anchor is equally likely. Serde lets a variant without a list of fields have any.
    Uniform {},
    /// By priority, the proportional rule of Schaul et al. 2016: P(i) = p_i^alpha / sum_j p_j^alpha, where p_i is the C51 loss of
    /// transition i when it was learned from last. A row's loss is weighted by (N P(i))^-beta, over the batch's largest.
    Prioritised {
        /// How much priorities count, 0 to 1: at 0 all rows are equally likely.
        alpha: f64,
        /// beta at the first update, 0 to 1: at 1 weights undo the whole bias of the draw, at 0 nothing of it.
        beta_start: f64,
        /// beta from `beta_updates` on, no less than `beta_start`, at most 1.
        beta_end: f64,
        /// Updates over which beta rises, in a straight line.
        beta_updates: u64,
    },
}

impl Default for Sampling {
    fn default() -> Self {
        Self::Uniform {}
    }
}

impl Sampling {
    /// Whether rows are drawn by priority: then batches say how likely each was, and the learner answers with priorities.
    pub const fn is_prioritised(&self) -> bool {
        matches!(self, Self::Prioritised { .. })
    }

    /// beta at the update that follows `updates`.
    pub fn beta(&self, updates: u64) -> f64 {
        match *self {
            Self::Uniform {} => 0.0,
            Self::Prioritised {
                beta_start,
                beta_end,
                beta_updates,
                ..
            } => {
                let share = updates.min(beta_updates) as f64 / beta_updates.max(1) as f64;
                beta_start + share * (beta_end - beta_start)
            }
        }
    }

    /// Checks every number's range.
    pub fn validate(&self) -> Result<(), ConfigError> {
        let Self::Prioritised {
            alpha,
            beta_start,
            beta_end,
            beta_updates,
        } = *self
        else {
            return Ok(());
        };
        for (key, value) in [
            ("replay.sampling.alpha", alpha),
            ("replay.sampling.beta_start", beta_start),
            ("replay.sampling.beta_end", beta_end),
        ] {
            let fits = (0.0..=1.0).contains(&value);
            check(fits, key, value, || "it lies between 0 and 1")?;
        }
        let key = "replay.sampling.beta_end";
        let why = "beta rises: use at least beta_start";
        check(beta_end >= beta_start, key, beta_end, || why)?;
        let key = "replay.sampling.beta_updates";
        let why = "beta rises over at least one update";
        check(beta_updates > 0, key, beta_updates, || why)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn rule(numbers: [f64; 3], beta_updates: u64) -> Sampling {
        let [alpha, beta_start, beta_end] = numbers;
        Sampling::Prioritised {
            alpha,
            beta_start,
            beta_end,
            beta_updates,
        }
    }

    #[test]
    fn beta_rises_in_a_straight_line_and_stays() {
        let rule = rule([0.5, 0.4, 1.0], 600);
        for (updates, beta) in [(0, 0.4), (300, 0.7), (600, 1.0), (u64::MAX, 1.0)] {
            assert!((rule.beta(updates) - beta).abs() < 1e-12);
        }
        assert_eq!(Sampling::Uniform {}.beta(7), 0.0);
    }

    #[test]
    fn numbers_out_of_range_are_named() {
        assert_eq!(rule([0.5, 0.4, 1.0], 600).validate(), Ok(()));
        assert_eq!(Sampling::Uniform {}.validate(), Ok(()));
        for (numbers, beta_updates, key) in [
            ([-0.1, 0.4, 1.0], 600, "alpha"),
            ([f64::NAN, 0.4, 1.0], 600, "alpha"),
            ([f64::INFINITY, 0.4, 1.0], 600, "alpha"),
            ([0.5, 1.5, 1.0], 600, "beta_start"),
            ([0.5, 0.4, 2.0], 600, "beta_end"),
            ([0.5, 0.4, 0.3], 600, "beta_end"),
            ([0.5, 0.4, 1.0], 0, "beta_updates"),
        ] {
            let said = rule(numbers, beta_updates).validate();
            let said = said.unwrap_err().to_string();
            let key = format!("replay.sampling.{key} = ");
            assert!(said.starts_with(&key), "{said}");
        }
    }
}
