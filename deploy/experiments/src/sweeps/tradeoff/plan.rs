//! Which levels fit into a budget, and what the plan says before anything is run.
//! It knows seconds and names; what they cost is measured in `speed` or by runs that are finished.

use std::collections::BTreeSet;

/// A level and its base, with the seconds that are still to be run of each.
#[derive(Clone, Debug)]
pub(super) struct Candidate {
    pub(super) base: Cost,
    pub(super) level: Cost,
}

/// What is left to run of all seeds of a point.
#[derive(Clone, Debug)]
pub(super) struct Cost {
    pub(super) key: String,
    pub(super) seconds: f64,
}

/// Which candidates fit into `budget_seconds`, in their order, each with all its seeds and its base or not at all. What costs nothing
/// any more always fits. A candidate that does not fit leaves room to those after it.
pub(super) fn fit(candidates: &[Candidate], budget_seconds: f64) -> Vec<bool> {
    let mut paid = BTreeSet::new();
    let mut used = 0.0;
    let mut chosen = Vec::with_capacity(candidates.len());
    for Candidate { base, level } in candidates {
        let mut new = vec![base, level];
        new.retain(|cost| !paid.contains(cost.key.as_str()));
        let more: f64 = new.iter().map(|cost| cost.seconds).sum();
        let fits = more == 0.0 || used + more <= budget_seconds;
        if fits {
            used += more;
            paid.extend(new.iter().map(|cost| cost.key.as_str()));
        }
        chosen.push(fits);
    }
    chosen
}

/// Seconds of the chosen candidates, each point counted once.
pub(super) fn seconds(candidates: &[Candidate], chosen: &[bool]) -> f64 {
    let mut paid = BTreeSet::new();
    let chosen = candidates.iter().zip(chosen).filter(|(_, chosen)| **chosen);
    let costs = chosen.flat_map(|(it, _)| [&it.base, &it.level]);
    let new = costs.filter(|cost| paid.insert(cost.key.as_str()));
    // A sum of nothing is -0.
    new.map(|cost| cost.seconds).sum::<f64>() + 0.0
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

    fn candidate(base: (&str, f64), level: (&str, f64)) -> Candidate {
        let cost = |(key, seconds): (&str, f64)| Cost {
            key: key.into(),
            seconds,
        };
        Candidate {
            base: cost(base),
            level: cost(level),
        }
    }

    #[test]
    fn a_budget_is_kept_and_a_base_is_paid_once() {
        let all = [
            candidate(("c51", 100.0), ("bf16", 60.0)),
            candidate(("c51", 100.0), ("driml-fix", 200.0)),
            candidate(("c51", 100.0), ("f16", 100.0)),
            candidate(("driml-fix", 200.0), ("rkhs", 40.0)),
        ];
        for (budget, expected, seconds_used) in [
            (0.0, [false; 4], 0.0),
            (159.9, [false; 4], 0.0),
            (160.0, [true, false, false, false], 160.0),
            (260.0, [true, false, true, false], 260.0),
            (400.0, [true, true, false, true], 400.0),
            (500.0, [true; 4], 500.0),
        ] {
            let chosen = fit(&all, budget);
            assert_eq!(chosen, expected, "{budget} s");
            assert_eq!(seconds(&all, &chosen), seconds_used);
            assert!(seconds_used <= budget);
        }
    }

    #[test]
    fn what_is_finished_costs_nothing_and_is_always_there() {
        let all = [
            candidate(("c51", 0.0), ("bf16", 0.0)),
            candidate(("c51", 0.0), ("f16", 50.0)),
        ];
        assert_eq!(fit(&all, 0.0), [true, false]);
        assert_eq!(fit(&all, 50.0), [true, true]);
    }

    #[test]
    fn a_small_budget_makes_shorter_runs() {
        assert_eq!(frames(40_000, 300.0, 400.0), 40_000);
        assert_eq!(frames(40_000, 300.0, 200.0), 20_000);
        assert_eq!(frames(40_000, 300.0, 80.0), 10_000);
        assert_eq!(frames(40_000, 300.0, 1.0), 10_000);
    }
}
