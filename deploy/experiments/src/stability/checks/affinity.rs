//! Both estimates of the action affinity.

use driml_learner::{
    AffinityEstimator, Alphabet, ExactAffinity, ExactSettings, LearnedAffinity, LearnedSettings,
};
use rand::Rng;
use rand_chacha::ChaCha8Rng;

use crate::stability::{
    edges::{exact_sum, off, worst},
    property::Cases,
};

/// As the preset has them.
pub(super) const LEARNED: LearnedSettings = LearnedSettings {
    hidden: 32,
    lr: 2e-3,
    beta1: 0.9,
    beta2: 0.999,
    eps: 1e-8,
    keep: 0.9,
};
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
            (action, if action + 1 == actions { 0 } else { action + 1 })
        }
        2 => (actions - 1, actions - 1),
        _ => (rng.random_range(0..half), rng.random_range(0..half)),
    };
    let count = if which == 4 { 1 } else { 64 };
    (0..count).map(|_| pair()).collect()
}

/// The largest distance of a row's sum from 1; NaN where an entry is not a probability.
fn row_sum_error(matrix: &[f32], actions: usize) -> f64 {
    worst(matrix.chunks_exact(actions).map(|row| {
        match row.iter().all(|a| (0.0..=1.0 + 1e-6).contains(a)) {
            true => (exact_sum(row.iter().map(|&a| a.into())) - 1.0).abs(),
            false => f64::NAN,
        }
    }))
}

/// A of these counts: each row of (c + s) / (e + s), e = what independent actions would have, over its sum.
fn closed_form(counts: &[f64], actions: usize, smoothing: f64) -> Vec<f64> {
    let row = |i: usize| exact_sum((0..actions).map(|j| counts[i * actions + j]));
    let column = |j: usize| exact_sum((0..actions).map(|i| counts[i * actions + j]));
    let columns: Vec<f64> = (0..actions).map(column).collect();
    let total = exact_sum(columns.iter().copied());
    let row = |i: usize| {
        let sum_of_row = row(i);
        let ratio = |j: usize| {
            let independent = match total {
                0.0 => 0.0,
                _ => sum_of_row * (columns[j] / total),
            };
            (counts[i * actions + j] + smoothing) / (independent + smoothing)
        };
        let ratios: Vec<f64> = (0..actions).map(ratio).collect();
        let sum = exact_sum(ratios.iter().copied());
        ratios.into_iter().map(move |ratio| ratio / sum)
    };
    (0..actions).flat_map(row).collect()
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

fn see_exact(
    cases: &mut Cases<'_>,
    actions: usize,
    settings: ExactSettings,
    start: f64,
) -> anyhow::Result<()> {
    for (which, used) in USES.iter().enumerate() {
        let mut estimate = counted(actions, settings, start)?;
        let mut counts = vec![start; actions * actions];
        for _ in 0..8 {
            let pairs = pairs(which, actions as u8, &mut cases.rng);
            estimate.observe(&pairs, &mut cases.rng)?;
            counts.iter_mut().for_each(|count| *count *= settings.decay);
            for (i, j) in pairs {
                counts[usize::from(i) * actions + usize::from(j)] += 1.0;
            }
        }
        let found = estimate.matrix();
        let expected = closed_form(&counts, actions, settings.smoothing);
        let of_entries = found
            .iter()
            .zip(expected)
            .map(|(&a, expected)| off(a, expected));
        let errors = [worst(of_entries), row_sum_error(found, actions)];
        let extreme = "2, 15, 60 actions, five uses of them; counts from 0, 2^24, 2^53, 1e299; decay 1, 0.999, 0.5, 1e-300; smoothing 1e-100, 1, 1e100";
        let input = format_args!("{actions} actions, {used}, counts from {start:e}, {settings:?}");
        cases.see(extreme, input, errors)?;
    }
    Ok(())
}

pub(crate) fn exact(cases: &mut Cases<'_>) -> anyhow::Result<()> {
    for actions in [2usize, 15, 60] {
        for decay in [1.0, 0.999, 0.5, 1e-300] {
            for smoothing in [1e-100, 1.0, 1e100] {
                for start in [0.0, 2f64.powi(24), 2f64.powi(53), 1e299] {
                    see_exact(cases, actions, ExactSettings { decay, smoothing }, start)?;
                }
            }
        }
    }
    Ok(())
}

pub(crate) fn learned(cases: &mut Cases<'_>) -> anyhow::Result<()> {
    let updates = cases.settings.affinity_updates;
    let fewer = updates / 100;
    let extreme =
        format!("2, 15 actions, five uses of them, {updates} updates; 255 actions, {fewer}");
    for (actions, updates) in [(2usize, updates), (15, updates), (255, fewer)] {
        for (which, used) in USES.iter().enumerate() {
            let alphabet = Alphabet::raw(actions)?;
            let learned = LearnedAffinity::new(alphabet, LEARNED, &mut cases.rng)?;
            let mut estimate = AffinityEstimator::Learned(learned);
            for update in 1..=updates {
                let pairs = pairs(which, actions as u8, &mut cases.rng);
                estimate.observe(&pairs, &mut cases.rng)?;
                let error = row_sum_error(estimate.matrix(), actions);
                let input = format_args!("{actions} actions, {used}, update {update}");
                cases.see(&extreme, input, [error])?;
            }
            if which == 2 {
                let entries = estimate.matrix().iter();
                let uniform = 1.0 / actions as f64;
                let error = worst(entries.map(|&a| (f64::from(a) - uniform).abs()));
                let input = format_args!("{actions} actions");
                cases.see("always the same action", input, [None, Some(error)])?;
            }
        }
    }
    Ok(())
}
