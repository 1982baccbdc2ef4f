//! Chooses which levels fit into a budget.
//! This module only knows seconds and names. The costs come from `measured` or from finished runs.

use std::collections::BTreeSet;

#[derive(Clone, Debug)]
pub(super) struct Cost {
    pub(super) key: String,
    pub(super) seconds: f64,
}

/// A budget of machine time, and the points on which it is spent.
#[derive(Debug, Default)]
pub(super) struct Budget {
    pub(super) seconds_max: f64,
    /// The seconds of everything taken. Each point counts once.
    pub(super) seconds: f64,
    taken: BTreeSet<String>,
}

impl Budget {
    pub(super) fn new(seconds_max: f64) -> Self {
        Self {
            seconds_max,
            ..Self::default()
        }
    }

    /// Takes a level and its base with all their seeds if both fit, and returns whether it does. A level that costs nothing always fits. A
    /// level that does not fit leaves its room to later levels.
    pub(super) fn try_take(&mut self, base_and_level: &[Cost; 2]) -> bool {
        let both = base_and_level.iter();
        let new = both.clone().filter(|it| !self.taken.contains(&it.key));
        let more: f64 = new.map(|it| it.seconds).sum();
        let fits = more == 0.0 || self.seconds + more <= self.seconds_max;
        if fits {
            self.seconds += more;
            self.taken.extend(both.map(|it| it.key.clone()));
        }
        fits
    }
}

/// Returns the frames of a run: the largest of `full`, its half and its quarter with which the first level and its base fit into the
/// budget, or `full` if none fits. `seconds` is what both take with all seeds and `full` frames.
pub(super) fn choose_frames(full: u64, seconds: f64, budget_seconds: f64) -> u64 {
    let lengths = [full, full / 2, full / 4];
    let fits = |frames: &u64| seconds * *frames as f64 / full as f64 <= budget_seconds;
    lengths.into_iter().find(fits).unwrap_or(full)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_budget_is_kept_and_a_base_is_paid_once() {
        let all = [
            [("c51", 100.0), ("bf16", 60.0)],
            [("c51", 100.0), ("driml-fix", 200.0)],
            [("c51", 100.0), ("f16", 100.0)],
            [("driml-fix", 200.0), ("embedding_dim", 40.0)],
        ];
        // Finished points cost nothing and are always taken.
        let finished = [[("c51", 0.0), ("bf16", 0.0)], [("c51", 0.0), ("f16", 50.0)]];
        for (levels, seconds_max, chosen, seconds) in [
            (&all[..], 0.0, &[false; 4][..], 0.0),
            (&all, 159.9, &[false; 4], 0.0),
            (&all, 160.0, &[true, false, false, false], 160.0),
            (&all, 260.0, &[true, false, true, false], 260.0),
            (&all, 400.0, &[true, true, false, true], 400.0),
            (&all, 500.0, &[true; 4], 500.0),
            (&finished, 0.0, &[true, false], 0.0),
            (&finished, 50.0, &[true, true], 50.0),
        ] {
            let mut budget = Budget::new(seconds_max);
            let costs = levels.iter().map(|both| {
                both.map(|(key, seconds)| Cost {
                    key: key.to_owned(),
                    seconds,
                })
            });
            let found: Vec<_> = costs.map(|it| budget.try_take(&it)).collect();
            let found = (&found[..], budget.seconds);
            assert_eq!(found, (chosen, seconds), "{seconds_max} s");
        }
    }

    #[test]
    fn a_small_budget_makes_shorter_runs() {
        let found = [400.0, 200.0, 80.0, 1.0].map(|budget| choose_frames(40_000, 300.0, budget));
        assert_eq!(found, [40_000, 20_000, 10_000, 40_000]);
    }
}
