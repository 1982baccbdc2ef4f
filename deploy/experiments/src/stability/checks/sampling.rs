//! How batches are sampled: k along the stored actions, rows by priority, and the importance weights that correct the bias.

use anyhow::Context;
use driml_learner::importance::{WEIGHT_ERROR, importance_weights};
use driml_protocol::{AffinityUpdate, End, PriorityPart, PriorityUpdate, RunSpec, Sampling};
use driml_replay_server::{
    PRIORITY_MIN, PROBABILITY_ERROR, Replay,
    horizon::{
        Affinity,
        nhg::{CONTINUE_ERROR, draw_k},
    },
};
use rand::RngCore;

use super::replay::{new_replay, numbered_spec, step_number};
use crate::stability::property::*;

/// The limit of the chi-square test in standard deviations. A correct sampler exceeds it once in two million tests.
const DEVIATIONS: f64 = 5.0;

const EVERY: &str =
    "A 0, 1e-45, 1e-9, 0.5, 1 - 6e-8, 1 and drawn; all 2^24 values that a draw can have";
const WALKS: &str = "H 1, 2, 5, 50, 255, 1,000; A 0, 1e-9, 0.5, 0.99, 1 - 6e-8, 1, and drawn";
const PRIORITIES: &str =
    "all 0, 1e-45, 1, 3.4e38; one of 3.4e38 among 0; 1e-45 to 3.4e38; alpha 0, 0.5, 1";
const CHANCES: &str =
    "2 to 64 rows, chances 1.2e-38 to 1 and equal ones, beta 0, 1 and between, drawn";

pub(super) fn properties() -> Vec<Property> {
    let priorities = "priorities, which are C51 losses, 0 to 3.4e38; alpha 0 to 1";
    vec![
        Property::new("k by NHG", "A 0 to 1; k_max 1 to 1,000")
            .promise("the probability of a step, beside A", CONTINUE_ERROR)
            .promise("chi-square of k, in deviations", DEVIATIONS)
            .check(EVERY, Listed, probability_of_a_step)
            .check(WALKS, Listed, distribution_of_k),
        Property::new("prioritised draw", priorities)
            .promise("a row's chance, as a share of it", PROBABILITY_ERROR)
            .promise("chi-square of the draws, in deviations", DEVIATIONS)
            .check(PRIORITIES, Listed, prioritised)
            .check("drawn", Drawn(0.01), prioritised),
        Property::new("importance weight", "chances 1.2e-38 to 1; beta 0 to 1")
            // The weight of the least likely row is exactly 1.
            .promise("a weight, as a share of it", WEIGHT_ERROR)
            .check(CHANCES, Drawn(1.0), weights),
    ]
}

/// A generator from which a drawn float takes each of its 2^24 values in turn.
struct EveryFloat(u32);

impl RngCore for EveryFloat {
    fn next_u32(&mut self) -> u32 {
        self.0 = self.0.wrapping_add(1 << 8);
        self.0
    }

    fn next_u64(&mut self) -> u64 {
        u64::from(self.next_u32())
    }

    fn fill_bytes(&mut self, bytes: &mut [u8]) {
        bytes.fill(0);
    }
}

fn affinity_from(num_actions: u32, matrix: Vec<f32>) -> anyhow::Result<Affinity> {
    let mut affinity = Affinity::uniform(num_actions);
    affinity.update(&AffinityUpdate {
        learner: 1,
        version: 1,
        matrix,
    })?;
    Ok(affinity)
}

fn probability_of_a_step(cases: &mut Cases<'_>) -> anyhow::Result<()> {
    let listed = [0.0, -0.0, 1e-45, 1e-9, 0.5, 1.0 - f32::EPSILON / 2.0, 1.0];
    let mut all: Vec<Option<f32>> = listed.map(Some).to_vec();
    all.resize(all.len() + cases.settings.whole_draws as usize, None);
    let listed = cases.one_of(&all);
    let a = listed.unwrap_or_else(|| draw_probability(&mut cases.rng));
    let affinity = affinity_from(1, vec![a])?;
    let mut every = EveryFloat(0);
    let draws = 1u32 << 24;
    let longer = (0..draws).filter(|_| draw_k(&affinity, &[0, 0], &mut every) == 2);
    let found = longer.count() as f64 / f64::from(draws);
    // The probabilities 0 and 1 must be exact.
    let is_certain = a == 0.0 || a == 1.0;
    let error = found - f64::from(a);
    let error = nan_unless(!is_certain || error == 0.0, error);
    cases.record_errors(format_args!("A = {a:e}: {found}"), [error])
}

fn distribution_of_k(cases: &mut Cases<'_>) -> anyhow::Result<()> {
    let steps = cases.one_of(&[1usize, 2, 5, 50, 255, 1000]);
    let kind = cases.one_of(&[0, 1, 2, 3, 4, 5, 6, 7]);
    let rng = &mut cases.rng;
    let mut draw = || match [0.0, 1e-9, 0.5, 0.99, 1.0 - f32::EPSILON / 2.0, 1.0].get(kind) {
        Some(&a) => a,
        None if kind == 6 => rng.random(),
        None => draw_probability(rng),
    };
    let matrix: Vec<f32> = (0..16).map(|_| draw()).collect();
    let actions: Vec<u8> = (0..steps).map(|_| rng.random_range(0..4)).collect();
    // P(k = i) for i = 1, .., H along these actions.
    let (mut reached, mut distribution) = (1.0, Vec::new());
    for pair in actions.windows(2) {
        let a = f64::from(matrix[usize::from(pair[0]) * 4 + usize::from(pair[1])]);
        distribution.push(reached * (1.0 - a));
        reached *= a;
    }
    distribution.push(reached);
    let affinity = affinity_from(4, matrix)?;
    let mut counts = vec![0; steps];
    for _ in 0..cases.settings.law_draws / 10 {
        counts[draw_k(&affinity, &actions, rng) as usize - 1] += 1;
    }
    let input = format_args!("H = {steps}, kind {kind} of A");
    cases.record_errors(input, [None, Some(deviations(&counts, &distribution))])
}

/// Returns how far counts deviate from a distribution: their chi-square as standard deviations of a normal with the same tail, 0 or more.
///
/// Pearson's chi-square by Wilson and Hilferty 1931 (cube root). Cells that expect fewer than 5 are merged. Infinite for impossible values,
/// and if cells that together expect fewer than 5 have more than `RARE_MAX`, which a Poisson variable exceeds with a chance below 1e-6.
fn deviations(counts: &[u64], distribution: &[f64]) -> f64 {
    let total = counts.iter().sum::<u64>() as f64;
    let (mut cells, mut rare) = (Vec::new(), (0.0, 0.0));
    for (&count, &p) in counts.iter().zip(distribution) {
        match total * p {
            0.0 if count > 0 => return f64::INFINITY,
            expected if expected < 5.0 => rare = (rare.0 + count as f64, rare.1 + expected),
            expected => cells.push((count as f64, expected)),
        }
    }
    const RARE_MAX: f64 = 20.0;
    match rare {
        (_, 5.0..) => cells.push(rare),
        (have, _) if have > RARE_MAX => return f64::INFINITY,
        _ => {}
    }
    let degrees = cells.len().saturating_sub(1) as f64;
    if degrees == 0.0 {
        return 0.0;
    }
    let term = |(have, want): &(f64, f64)| (have - want).powi(2) / want;
    let square = exact_sum(cells.iter().map(term));
    let spread = 2.0 / (9.0 * degrees);
    (((square / degrees).cbrt() - (1.0 - spread)) / spread.sqrt()).max(0.0)
}

/// The number of transitions that can be drawn by priority.
const TRANSITIONS: usize = 300;
const ROWS: u32 = 64;

fn prioritised(cases: &mut Cases<'_>) -> anyhow::Result<()> {
    let kinds: [fn(usize) -> f32; 6] = [
        |_| 0.0,
        |_| 1e-45,
        |_| 1.0,
        |_| f32::MAX,
        |at| if at == TRANSITIONS / 2 { f32::MAX } else { 0.0 },
        |at| 10f64.powf(-45.0 + 83.5 * at as f64 / TRANSITIONS as f64) as f32,
    ];
    let listed = kinds.map(|kind| (0..TRANSITIONS).map(kind).collect());
    let priorities = cases.listed_or(&listed, |rng| {
        let sizes = draw_finites(TRANSITIONS, rng).into_iter();
        sizes.map(f32::abs).collect::<Vec<_>>()
    });
    let alpha = cases.listed_or(&[0.0, 0.5, 1.0], |rng| rng.random());
    // Listed inputs draw many batches for the chi-square; a drawn input has only one batch, too few for it.
    let batches = cases.listed_or(&[cases.settings.law_draws / u64::from(ROWS)], |_| 1);

    let sampling = Sampling::Prioritised {
        alpha,
        beta_start: 0.4,
        beta_end: 1.0,
        beta_updates: 100,
    };
    let spec = RunSpec {
        seed: cases.rng.random(),
        ..numbered_spec()
    };
    // One step more than transitions, because the last step has no successor.
    let steps = [(1.0, End::Running); TRANSITIONS + 1];
    let mut replay = new_replay(&spec, sampling, ROWS, &steps)?;
    let batch_of = |replay: &mut Replay| {
        let batch = replay.sample(ROWS);
        batch.map_err(|why| anyhow::anyhow!("no batch: {why:?}"))
    };
    let origin = batch_of(&mut replay)?.header.origin;
    let update = PriorityUpdate {
        learner: 1,
        number: 1,
        parts: vec![PriorityPart {
            origin: origin.context("rows drawn by priority")?,
            transitions: (0..TRANSITIONS as u64).collect(),
            priorities: priorities.clone(),
        }],
    };
    replay.set_priorities(&update).map_err(anyhow::Error::msg)?;
    let mass = |&priority: &f32| (f64::from(priority) + PRIORITY_MIN).powf(alpha);
    let sum = exact_sum(priorities.iter().map(mass));
    let distribution: Vec<f64> = priorities.iter().map(|it| mass(it) / sum).collect();
    let mut counts = vec![0; TRANSITIONS];
    for _ in 0..batches {
        let batch = batch_of(&mut replay)?;
        let chances = batch.probabilities().context("rows drawn by priority")?;
        for (frame, chance) in batch.states_t().chunks_exact(4).zip(chances) {
            let transition = step_number(frame);
            counts[transition] += 1;
            // A chance below the smallest normal number is reported as that number.
            let expected = distribution[transition];
            let error = f64::from(chance) / expected.max(MIN_NORMAL) - 1.0;
            let input = format_args!("{chance:e}, which should be {expected:e}");
            cases.record_errors(input, [error])?;
        }
    }
    if batches > 1 {
        let input = format_args!("alpha {alpha}, priorities {}", Preview(&priorities));
        cases.record_errors(input, [None, Some(deviations(&counts, &distribution))])?;
    }
    Ok(())
}

fn weights(cases: &mut Cases<'_>) -> anyhow::Result<()> {
    let rng = &mut cases.rng;
    let mut chances = draw_finites(rng.random_range(2..=64), rng);
    if rng.random_bool(0.2) {
        chances.fill(draw_finite(rng));
    }
    for it in &mut chances {
        *it = it.abs().clamp(f32::MIN_POSITIVE, 1.0);
    }
    let beta = match rng.random_range(0..4) {
        0 => 0.0,
        1 => 1.0,
        _ => rng.random(),
    };
    let least = chances.iter().copied().fold(f32::INFINITY, f32::min);
    let found = importance_weights(&chances, beta);
    for (&found, &chance) in found.iter().zip(&chances) {
        let expected = (beta * (f64::from(least).ln() - f64::from(chance).ln())).exp();
        let error = nan_unless(chance != least || found == 1.0, rel_error(found, expected));
        let input = format_args!("beta {beta}, chances {}", Preview(&chances));
        cases.record_errors(input, [error])?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_wrong_law_deviates_and_a_right_one_does_not() {
        assert!(deviations(&[500, 510], &[0.5, 0.5]) < 1.0);
        assert!(deviations(&[60_000, 40_000], &[0.5, 0.5]) > 10.0);
        assert!(deviations(&[1, 99], &[0.0, 1.0]).is_infinite());
        let nearly_certain = [1.0 - 1e-9, 1e-9];
        assert!(deviations(&[0, 100_000], &nearly_certain).is_infinite());
        assert_eq!(deviations(&[99_999, 1], &nearly_certain), 0.0);
    }
}
