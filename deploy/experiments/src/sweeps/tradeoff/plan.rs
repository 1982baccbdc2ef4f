//! Chooses which levels fit into a budget.
//! This module only knows seconds and names. The costs come from `measured` or from finished runs.

use std::collections::BTreeMap;

/// The name of a point, and the seconds that its unfinished runs take.
pub(super) type Cost = (String, f64);

/// Returns which levels fit into `seconds_max`, each with its base and all seeds, and the seconds of all that fit. Each point is paid once,
/// at its highest cost: as a base, it has more seeds.
/// A level that costs nothing always fits. One that does not fit leaves its room to later levels.
pub(super) fn choose_levels(base_and_level: &[[Cost; 2]], seconds_max: f64) -> (Vec<bool>, f64) {
    let (mut seconds, mut paid) = (0.0, BTreeMap::new());
    let fits = base_and_level.iter().map(|both| {
        let due = |(key, cost): &Cost| (cost - paid.get(key).unwrap_or(&0.0)).max(0.0);
        let more: f64 = both.iter().map(due).sum();
        let fits = more == 0.0 || seconds + more <= seconds_max;
        if fits {
            seconds += more;
            for (key, cost) in both {
                let paid = paid.entry(key).or_insert(0.0);
                *paid = f64::max(*paid, *cost);
            }
        }
        fits
    });
    (fits.collect(), seconds)
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
        let becomes_a_base = [
            [("c51", 100.0), ("driml-fix", 100.0)],
            [("driml-fix", 200.0), ("embedding_dim", 40.0)],
        ];
        for (levels, seconds_max, chosen, seconds) in [
            (&all[..], 0.0, &[false; 4][..], 0.0),
            (&all, 159.9, &[false; 4], 0.0),
            (&all, 160.0, &[true, false, false, false], 160.0),
            (&all, 260.0, &[true, false, true, false], 260.0),
            (&all, 400.0, &[true, true, false, true], 400.0),
            (&all, 500.0, &[true; 4], 500.0),
            (&finished, 0.0, &[true, false], 0.0),
            (&finished, 50.0, &[true, true], 50.0),
            (&becomes_a_base, 339.0, &[true, false], 200.0),
            (&becomes_a_base, 340.0, &[true, true], 340.0),
        ] {
            let owned = levels
                .iter()
                .map(|it| it.map(|(key, cost)| (key.to_owned(), cost)));
            let found = choose_levels(&owned.collect::<Vec<_>>(), seconds_max);
            assert_eq!(found, (chosen.to_vec(), seconds), "{seconds_max} s");
        }
    }

    #[test]
    fn a_small_budget_makes_shorter_runs() {
        let found = [400.0, 200.0, 80.0, 1.0].map(|budget| choose_frames(40_000, 300.0, budget));
        assert_eq!(found, [40_000, 20_000, 10_000, 40_000]);
    }
}
