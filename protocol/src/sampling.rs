//! The rules by which the replay draws the rows of a batch, with the parameters that the learner needs.
//! The replay server implements the drawing, the learner the weighting.

use serde::{Deserialize, Serialize};

use crate::config::{ConfigError, check, check_range};

/// The rule by which the replay draws the rows of a batch: the setting `replay.sampling`.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "rule", rename_all = "kebab-case", deny_unknown_fields)]
pub enum Sampling {
    /// Each transition that can be an anchor is equally likely. The braces make serde reject unknown fields, which a unit variant accepts.
    Uniform {},
    /// By priority, the proportional rule of Schaul et al. 2016: P(i) = p_i^alpha / sum_j p_j^alpha, where p_i is the C51 loss of
    /// transition i at the last update that used it, and j runs over the shard's transitions. A row's loss is weighted by
    /// (N P(i))^-beta, divided by the batch's largest weight.
    Prioritised {
        /// How much priorities count, 0 to 1: at 0 all rows are equally likely.
        alpha: f64,
        /// beta at the first update, 0 to 1: at 1 the weights remove the whole bias of the draw, at 0 none of it.
        beta_start: f64,
        /// beta after `beta_updates` updates, `beta_start` to 1.
        beta_end: f64,
        /// Number of updates over which beta rises linearly.
        beta_updates: u64,
    },
}

impl Default for Sampling {
    fn default() -> Self {
        Self::Uniform {}
    }
}

impl Sampling {
    /// Whether rows are drawn by priority. Batches then carry the probability of each row, and the learner sends priorities back.
    pub const fn is_prioritised(&self) -> bool {
        matches!(self, Self::Prioritised { .. })
    }

    /// Returns beta for the update that follows `updates` updates.
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

    /// Checks the range of every parameter.
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
            check_range(key, value, 0.0..=1.0, "it lies between 0 and 1")?;
        }
        let key = "replay.sampling.beta_end";
        let why = "beta rises: use at least beta_start";
        check(beta_end >= beta_start, key, beta_end, why)?;
        let key = "replay.sampling.beta_updates";
        let why = "beta rises over at least one update";
        check(beta_updates > 0, key, beta_updates, why)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn beta_rises_in_a_straight_line_and_stays() {
        let rule = Sampling::Prioritised {
            alpha: 0.5,
            beta_start: 0.4,
            beta_end: 1.0,
            beta_updates: 600,
        };
        for (updates, beta) in [(0, 0.4), (300, 0.7), (600, 1.0), (u64::MAX, 1.0)] {
            assert!((rule.beta(updates) - beta).abs() < 1e-12);
        }
        assert_eq!(Sampling::Uniform {}.beta(7), 0.0);
    }
}
