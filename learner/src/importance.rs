//! Corrections for rows that were not drawn equally likely: importance weights, and resampling to equal probabilities.
//! The probability of each row comes with its batch.

use rand::{Rng, distr::Distribution, distr::weighted::WeightedIndex};

/// Largest relative error of an importance weight: half a unit in the last place of an f32.
pub const WEIGHT_ERROR: f64 = 6.1e-8;

/// Computes `w_i = (N P(i))^-beta / max_j (N P(j))^-beta` with the maximum over the batch, so that weights only reduce a step. N cancels:
/// the result is `(min_j P(j) / P(i))^beta`.
///
/// `probabilities` [B], from 1.2e-38 to 1; `beta` in [0, 1]. Result [B], in (0, 1], 1 for the least likely row, each accurate to
/// [`WEIGHT_ERROR`]; beta = 0 gives 1 for all. Source: Schaul et al. 2016, Prioritized Experience Replay, section 3.4.
pub fn importance_weights(probabilities: &[f32], beta: f64) -> Vec<f32> {
    let least = probabilities.iter().copied().fold(f32::INFINITY, f32::min);
    let weight = |&p: &f32| (f64::from(least) / f64::from(p)).powf(beta) as f32;
    probabilities.iter().map(weight).collect()
}

/// Draws B rows with replacement, each with a probability proportional to 1 / P. They are distributed like rows drawn equally likely,
/// up to an error of the order of 1 / B.
///
/// `probabilities` [B], from 1.2e-38 to 1, B at least 1. Result [B], in 0..B. Source: Rubin 1987, sampling importance resampling.
pub fn resample_evenly(probabilities: &[f32], rng: &mut impl Rng) -> Vec<usize> {
    let weights = probabilities.iter().map(|&p| 1.0 / f64::from(p));
    let rows = WeightedIndex::new(weights).expect("chances are above 0, of one row at least");
    (0..probabilities.len()).map(|_| rows.sample(rng)).collect()
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;

    use super::*;

    #[test]
    fn rows_drawn_by_priority_and_then_evenly_are_equally_likely() {
        // Eight kinds of transitions, equally frequent in the replay, with priorities from 1 to 64.
        let priorities: Vec<f64> = (0..8).map(|kind| f64::from(1 + kind * 9)).collect();
        let sum: f64 = priorities.iter().sum();
        let by_priority = WeightedIndex::new(&priorities).unwrap();
        let mut rng = ChaCha8Rng::seed_from_u64(11);
        let (mut drawn, mut even) = ([0f64; 8], [0f64; 8]);
        let batches = 8_000;
        for _ in 0..batches {
            let kinds: Vec<usize> = (0..256).map(|_| by_priority.sample(&mut rng)).collect();
            let chance = |&kind: &usize| (priorities[kind] / sum) as f32;
            let chances: Vec<f32> = kinds.iter().map(chance).collect();
            // One row of each batch, as rows of the same batch depend on each other.
            drawn[kinds[0]] += 1.0;
            even[kinds[resample_evenly(&chances, &mut rng)[0]]] += 1.0;
        }
        let chi_square = |counts: [f64; 8]| {
            let expected = f64::from(batches) / 8.0;
            let terms = counts.map(|it| (it - expected).powi(2) / expected);
            terms.iter().sum::<f64>()
        };
        // 7 degrees of freedom: the statistic exceeds 24.3 with probability 0.001.
        assert!(chi_square(drawn) > 1_000.0);
        assert!(chi_square(even) < 24.3, "{even:?}");
    }
}
