//! Which levels fit into a budget.
//! It knows seconds and names; what they cost is measured in `measured` or by runs that are finished.

use std::collections::BTreeSet;

/// What is left to run of all seeds of a point.
#[derive(Clone, Debug)]
pub(super) struct Cost {
    pub(super) key: String,
    pub(super) seconds: f64,
}

#[derive(Debug, PartialEq)]
pub(super) struct Fit {
    /// Whether each level does.
    pub(super) chosen: Vec<bool>,
    /// What those cost together, each point counted once.
    pub(super) seconds: f64,
}

/// Which levels fit into `budget_seconds`, in their order, each with all its seeds and its base or not at all; of each the cost of
/// its base and its own, none for a level that is not asked for. What costs nothing any more always fits. A level that does not fit
/// leaves room to those after it.
pub(super) fn fit(levels: &[Option<[Cost; 2]>], budget_seconds: f64) -> Fit {
    let mut paid = BTreeSet::new();
    let mut seconds = 0.0;
    let mut fits = |costs: &'_ [Cost; 2]| {
        let new = costs.iter().filter(|it| !paid.contains(&it.key));
        let more: f64 = new.map(|it| it.seconds).sum();
        let fits = more == 0.0 || seconds + more <= budget_seconds;
        if fits {
            seconds += more;
            paid.extend(costs.iter().map(|it| it.key.clone()));
        }
        fits
    };
    let chosen = levels.iter().map(|it| it.as_ref().is_some_and(&mut fits));
    let chosen = chosen.collect();
    Fit { chosen, seconds }
}

/// Frames of a run: `full`, or a half or a quarter of it, so that at least the first level fits into the budget with its base.
/// `seconds` is what these two take with all seeds and `full` frames.
pub(super) fn frames(full: u64, seconds: f64, budget_seconds: f64) -> u64 {
    let lengths = [full, full / 2, full / 4];
    let fits = |frames: &u64| seconds * *frames as f64 / full as f64 <= budget_seconds;
    lengths.into_iter().find(fits).unwrap_or(full / 4)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_budget_is_kept_and_a_base_is_paid_once() {
        let level = |base: (&str, f64), level: (&str, f64)| {
            Some([base, level].map(|(key, seconds)| Cost {
                key: key.into(),
                seconds,
            }))
        };
        let all = [
            level(("c51", 100.0), ("bf16", 60.0)),
            level(("c51", 100.0), ("driml-fix", 200.0)),
            level(("c51", 100.0), ("f16", 100.0)),
            level(("driml-fix", 200.0), ("embedding_dim", 40.0)),
        ];
        // What is finished costs nothing and is always there; what is not asked for never is.
        let finished = [
            level(("c51", 0.0), ("bf16", 0.0)),
            level(("c51", 0.0), ("f16", 50.0)),
            None,
        ];
        for (all, budget, chosen, seconds) in [
            (&all[..], 0.0, vec![false; 4], 0.0),
            (&all, 159.9, vec![false; 4], 0.0),
            (&all, 160.0, vec![true, false, false, false], 160.0),
            (&all, 260.0, vec![true, false, true, false], 260.0),
            (&all, 400.0, vec![true, true, false, true], 400.0),
            (&all, 500.0, vec![true; 4], 500.0),
            (&finished, 0.0, vec![true, false, false], 0.0),
            (&finished, 50.0, vec![true, true, false], 50.0),
        ] {
            assert_eq!(fit(all, budget), Fit { chosen, seconds }, "{budget} s");
        }
    }

    #[test]
    fn a_small_budget_makes_shorter_runs() {
        let found = [400.0, 200.0, 80.0, 1.0].map(|budget| frames(40_000, 300.0, budget));
        assert_eq!(found, [40_000, 20_000, 10_000, 10_000]);
    }
}
