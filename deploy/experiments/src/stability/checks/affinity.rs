//! Both estimators of the action affinity.

use anyhow::Context;
use driml_learner::{
    AffinityEstimator, Alphabet, ExactAffinity, ExactSettings, affinity::exact::ENTRY_ERROR,
};
use driml_machine::resources::Machine;
use driml_settings::flags::resolve_names;

use crate::stability::property::*;

/// The allowed error of a row's sum: four times half of the last place of an f32 near 1.
const ROW_SUM_ERROR: f64 = 2.5e-7;
/// The allowed distance of an entry from 1 / actions if the pairs carry no information: a quarter of the last place of an f32 at 1.
const UNIFORM_ERROR: f64 = 3e-8;

const ALWAYS: &str = "always the same action: an entry, beside 1 / actions";
const COUNTS: &str = "2, 15, 60 actions, five uses of them; counts from 0, 2^24, 2^53, 1e299; decay 1, 0.999, 0.5, 1e-300; smoothing 1e-100, 1, 1e100";

pub(super) fn properties(settings: &Settings) -> Vec<Property> {
    let counts = "counts below 1e300; decay 1e-300 to 1; smoothing 1e-100 to 1e100";
    let updates = settings.affinity_updates;
    let updates = format!(
        "2, 15 actions, five uses of them, {updates} updates; 255 actions, a hundredth as many"
    );
    vec![
        Property::new("affinity, exact", counts)
            .promise("an entry, as a share of it", ENTRY_ERROR)
            .promise("a row's sum, beside 1", ROW_SUM_ERROR)
            .check(COUNTS, Listed, exact),
        Property::new("affinity, learned", "any pairs of 1 to 255 actions")
            .promise("a row's sum, beside 1, at any update", ROW_SUM_ERROR)
            // If there is only one pair, it does not tell how actions follow each other.
            .promise(ALWAYS, UNIFORM_ERROR)
            .check(&updates, Listed, learned),
    ]
}

/// A way in which actions are used: its name, the number of pairs in a batch, and a function that draws a pair.
type ActionUse = (&'static str, usize, fn(u8, &mut ChaCha8Rng) -> (u8, u8));

const USES: [ActionUse; 5] = [
    ("random", 64, draw_any_pair),
    ("in a cycle", 64, |actions, rng| {
        let action = rng.random_range(0..actions);
        (action, (action + 1) % actions)
    }),
    ("always the same", 64, |all, _| (all - 1, all - 1)),
    ("half of them never", 64, |actions, rng| {
        draw_any_pair(actions / 2, rng)
    }),
    ("one pair a batch", 1, draw_any_pair),
];

fn draw_any_pair(actions: u8, rng: &mut ChaCha8Rng) -> (u8, u8) {
    (rng.random_range(0..actions), rng.random_range(0..actions))
}

/// Returns the largest distance of a row's sum from 1; NaN if an entry is not a probability.
fn row_sum_error(matrix: &[f32], actions: usize) -> f64 {
    max_error(matrix.chunks_exact(actions).map(|row| {
        let are_probabilities = row.iter().all(|a| (0.0..=1.0 + 1e-6).contains(a));
        nan_unless(are_probabilities, (exact_sum(to_f64(row)) - 1.0).abs())
    }))
}

/// Computes A from counts c: (c + s) / (e + s), divided by its row's sum. e is the expected count of independent actions.
fn closed_form(counts: &[f64], actions: usize, smoothing: f64) -> Vec<f64> {
    let rows = || counts.chunks_exact(actions);
    let column = |j: usize| exact_sum(rows().map(|row| row[j]));
    let columns: Vec<f64> = (0..actions).map(column).collect();
    // Without counts, 0 divided by any positive total is 0.
    let total = exact_sum(columns.iter().copied()).max(f64::MIN_POSITIVE);
    let chances = rows().flat_map(|row| {
        let of_row = exact_sum(row.iter().copied());
        let ratio = |(count, column): (&f64, &f64)| {
            (count + smoothing) / (of_row * (column / total) + smoothing)
        };
        let ratios: Vec<f64> = row.iter().zip(&columns).map(ratio).collect();
        let sum = exact_sum(ratios.iter().copied());
        ratios.into_iter().map(move |ratio| ratio / sum)
    });
    chances.collect()
}

fn exact(cases: &mut Cases<'_>) -> anyhow::Result<()> {
    let actions = cases.one_of(&[2usize, 15, 60]);
    let settings = ExactSettings {
        decay: cases.one_of(&[1.0, 0.999, 0.5, 1e-300]),
        smoothing: cases.one_of(&[1e-100, 1.0, 1e100]),
    };
    // The initial count of each pair.
    let start = cases.one_of(&[0.0, 2f64.powi(24), 2f64.powi(53), 1e299]);
    let (use_name, count, draw_pair) = cases.one_of(&USES);
    let exact = ExactAffinity::new(Alphabet::raw(actions)?, settings)?;
    let mut state = serde_json::to_value(AffinityEstimator::Exact(exact))?;
    state["counts"] = vec![start; actions * actions].into();
    let mut estimate: AffinityEstimator = serde_json::from_value(state)?;
    let mut counts = vec![start; actions * actions];
    for _ in 0..8 {
        let pairs = (0..count).map(|_| draw_pair(actions as u8, &mut cases.rng));
        let pairs: Vec<_> = pairs.collect();
        estimate.observe(&pairs, &mut cases.rng)?;
        estimate.check_valid()?;
        counts.iter_mut().for_each(|it| *it *= settings.decay);
        for (i, j) in pairs {
            counts[usize::from(i) * actions + usize::from(j)] += 1.0;
        }
    }
    let found = estimate.matrix();
    let expected = closed_form(&counts, actions, settings.smoothing);
    let of_entries = found.iter().zip(expected).map(|(&a, it)| rel_error(a, it));
    let errors = [max_error(of_entries), row_sum_error(&found, actions)];
    let input = format_args!("{actions} actions, {use_name}, counts from {start:e}, {settings:?}");
    cases.record_errors(input, errors)
}

fn learned(cases: &mut Cases<'_>) -> anyhow::Result<()> {
    let updates = cases.settings.affinity_updates;
    let (actions, updates) = cases.one_of(&[(2u8, updates), (15, updates), (255, updates / 100)]);
    let preset = resolve_names("paper", "chain", "driml-ada", &[], &Machine::detect())?;
    let affinity = preset.learner.affinity;
    let estimate = affinity.make_estimator(actions.into(), &mut cases.rng)?;
    let mut estimate = estimate.context("driml-ada estimates it")?;
    let (use_name, count, draw_pair) = cases.one_of(&USES);
    for update in 1..=updates {
        let pairs = (0..count).map(|_| draw_pair(actions, &mut cases.rng));
        let pairs: Vec<_> = pairs.collect();
        estimate.observe(&pairs, &mut cases.rng)?;
        let matrix = estimate.matrix();
        let row_sum = row_sum_error(&matrix, actions.into());
        let is_last_of_one_pair = update == updates && use_name == "always the same";
        let deviation = |&a: &f32| (f64::from(a) - 1.0 / f64::from(actions)).abs();
        let uniform = is_last_of_one_pair.then(|| max_error(matrix.iter().map(deviation)));
        let input = format_args!("{actions} actions, {use_name}, update {update}");
        cases.record_errors(input, [Some(row_sum), uniform])?;
    }
    Ok(())
}
