//! Both estimates of the action affinity.

use driml_learner::{
    AffinityEstimator, Alphabet, ExactAffinity, ExactSettings, LearnedAffinity, LearnedSettings,
    affinity::exact::ENTRY_ERROR,
};
use rand::Rng;
use rand_chacha::ChaCha8Rng;

use crate::stability::{
    check::{Context, Routine, Row},
    edges::exact_sum,
    routines::losses::worse,
};

const EXACT: Routine = Routine {
    name: "affinity, exact",
    range: "counts below 1e300; decay above 0 and at most 1; smoothing 1e-100 to 1e100",
};
const LEARNED: Routine = Routine {
    name: "affinity, learned",
    range: "any pairs of 1 to 255 actions",
};
/// How far the sum of a row of A may be from 1: four times half of an f32's last place.
const ROW_SUM: f64 = 2.5e-7;
/// How far an entry may be from 1 / actions where no pair says anything: a quarter of an f32's last place at 1, as 1 / 15 has.
const UNIFORM_ERROR: f64 = 3e-8;

/// Ways in which actions are used.
const USES: [&str; 5] = [
    "random",
    "in a cycle",
    "always the same",
    "half of them never",
    "one pair a batch",
];

fn pairs(which: usize, actions: u8, rng: &mut ChaCha8Rng) -> Vec<(u8, u8)> {
    let half = (actions / 2).max(1);
    let mut pair = || match which {
        0 | 4 => (rng.random_range(0..actions), rng.random_range(0..actions)),
        1 => {
            let action = rng.random_range(0..actions);
            (action, ((u16::from(action) + 1) % u16::from(actions)) as u8)
        }
        2 => (actions - 1, actions - 1),
        _ => (rng.random_range(0..half), rng.random_range(0..half)),
    };
    (0..if which == 4 { 1 } else { 64 })
        .map(|_| pair())
        .collect()
}

/// The largest distance of a row's sum from 1; no number where an entry is no probability.
fn row_sum_error(matrix: &[f32], actions: usize) -> f64 {
    let rows = matrix.chunks_exact(actions).map(|row| {
        if row.iter().all(|a| (0.0..=1.0 + 1e-6).contains(a)) {
            (exact_sum(row.iter().map(|&a| a.into())) - 1.0).abs()
        } else {
            f64::NAN
        }
    });
    rows.fold(0.0, worse)
}

/// A of these counts: each row of (c + s) / (e + s), e = what independent actions would have, over its sum.
fn closed_form(counts: &[f64], actions: usize, smoothing: f64) -> Vec<f64> {
    let row = |i: usize| exact_sum((0..actions).map(|j| counts[i * actions + j]));
    let column = |j: usize| exact_sum((0..actions).map(|i| counts[i * actions + j]));
    let rows: Vec<f64> = (0..actions).map(row).collect();
    let columns: Vec<f64> = (0..actions).map(column).collect();
    let total = exact_sum(rows.iter().copied());
    let ratio = |i: usize, j: usize| {
        let independent = if total > 0.0 {
            rows[i] * (columns[j] / total)
        } else {
            0.0
        };
        (counts[i * actions + j] + smoothing) / (independent + smoothing)
    };
    let mut matrix = Vec::with_capacity(actions * actions);
    for i in 0..actions {
        let ratios: Vec<f64> = (0..actions).map(|j| ratio(i, j)).collect();
        let sum = exact_sum(ratios.iter().copied());
        matrix.extend(ratios.iter().map(|ratio| ratio / sum));
    }
    matrix
}

/// An exact estimate that has counted so many of each pair already.
fn counted(
    actions: usize,
    settings: ExactSettings,
    count: f64,
) -> anyhow::Result<AffinityEstimator> {
    let exact = ExactAffinity::new(Alphabet::raw(actions)?, settings)?;
    let mut state = serde_json::to_value(AffinityEstimator::Exact(exact))?;
    state["counts"] = vec![count.to_bits(); actions * actions].into();
    Ok(serde_json::from_value(state)?)
}

fn exact(context: &mut Context<'_>) -> anyhow::Result<Vec<Row>> {
    let extreme = "2, 15, 60 actions, five uses of them; counts from 0, 2^24, 2^53, 1e299; decay 1, 0.999, 0.5, 1e-300; smoothing 1e-100, 1, 1e100";
    let mut entry = Row::new(
        EXACT,
        extreme,
        "error of an entry, as a share of it (of 1.2e-38 below that)",
        ENTRY_ERROR,
    );
    let mut sums = Row::new(EXACT, extreme, "distance of a row's sum from 1", ROW_SUM);
    for actions in [2usize, 15, 60] {
        for decay in [1.0, 0.999, 0.5, 1e-300] {
            for smoothing in [1e-100, 1.0, 1e100] {
                for start in [0.0, 2f64.powi(24), 2f64.powi(53), 1e299] {
                    for (which, name) in USES.iter().enumerate() {
                        let settings = ExactSettings { decay, smoothing };
                        let mut estimate = counted(actions, settings, start)?;
                        let mut counts = vec![start; actions * actions];
                        for _ in 0..8 {
                            let pairs = pairs(which, actions as u8, &mut context.rng);
                            estimate.observe(&pairs, &mut context.rng)?;
                            counts.iter_mut().for_each(|count| *count *= decay);
                            for (i, j) in pairs {
                                counts[usize::from(i) * actions + usize::from(j)] += 1.0;
                            }
                        }
                        let input = || {
                            format!(
                                "{actions} actions, {name}, counts from {start:e}, decay {decay:e}, smoothing {smoothing:e}"
                            )
                        };
                        let expected = closed_form(&counts, actions, smoothing);
                        let errors = estimate.matrix().iter().zip(expected).map(|(a, b)| {
                            (f64::from(*a) - b).abs() / b.max(f32::MIN_POSITIVE.into())
                        });
                        entry.see(errors.fold(0.0, worse), input);
                        sums.see(row_sum_error(estimate.matrix(), actions), input);
                    }
                }
            }
            context.progress.advance(0)?;
        }
    }
    Ok(vec![entry, sums])
}

pub(super) fn check(context: &mut Context<'_>) -> anyhow::Result<Vec<Row>> {
    let mut rows = exact(context)?;
    let updates = context.settings.affinity_updates;
    let mut sums = Row::new(
        LEARNED,
        &format!(
            "2, 15 actions, five uses of them, {updates} updates; 255 actions, {}",
            updates / 100
        ),
        "distance of a row's sum from 1 at any update; every entry is a probability",
        ROW_SUM,
    );
    let mut uniform = Row::new(
        LEARNED,
        "always the same action",
        "distance of an entry from 1 / actions: one pair says nothing of how actions follow each other",
        UNIFORM_ERROR,
    );
    // The preset's numbers.
    let settings = LearnedSettings {
        hidden: 32,
        lr: 2e-3,
        beta1: 0.9,
        beta2: 0.999,
        eps: 1e-8,
        keep: 0.9,
    };
    for (actions, updates) in [(2usize, updates), (15, updates), (255, updates / 100)] {
        for (which, name) in USES.iter().enumerate() {
            let alphabet = Alphabet::raw(actions)?;
            let learned = LearnedAffinity::new(alphabet, settings, &mut context.rng)?;
            let mut estimate = AffinityEstimator::Learned(learned);
            for update in 1..=updates {
                let pairs = pairs(which, actions as u8, &mut context.rng);
                estimate.observe(&pairs, &mut context.rng)?;
                sums.see(row_sum_error(estimate.matrix(), actions), || {
                    format!("{actions} actions, {name}, update {update}")
                });
                if update % 64 == 0 {
                    context.progress.advance(0)?;
                }
            }
            if which == 2 {
                let each = estimate.matrix().iter();
                let errors = each.map(|&a| (f64::from(a) - 1.0 / actions as f64).abs());
                uniform.see(errors.fold(0.0, worse), || format!("{actions} actions"));
            }
        }
    }
    rows.extend([sums, uniform]);
    Ok(rows)
}
