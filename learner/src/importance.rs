//! Importance weights of rows that were not drawn equally likely.
//! It does not draw: the chance of each row comes with its batch.

/// Largest error of an importance weight, as a share of it: half of an f32's last place.
pub const WEIGHT_ERROR: f64 = 6.1e-8;

/// `w_i = (N P(i))^-beta / max_j (N P(j))^-beta`, the maximum over the batch: weights only ever make a step smaller. N cancels, so that
/// this is `(min_j P(j) / P(i))^beta`.
///
/// `probabilities` [B], from 1.2e-38 to 1; `beta` in [0, 1]. Result [B], in (0, 1], 1 for the least likely row, each right to
/// [`WEIGHT_ERROR`]; beta = 0 gives 1 for all. Source: Schaul et al. 2016, Prioritized Experience Replay, section 3.4.
pub fn importance_weights(probabilities: &[f32], beta: f64) -> Vec<f32> {
    let least = probabilities.iter().copied().fold(f32::INFINITY, f32::min);
    let weight = |&p: &f32| (f64::from(least) / f64::from(p)).powf(beta) as f32;
    probabilities.iter().map(weight).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn weights_are_the_paper_s() {
        let probabilities = [0.5f32, 0.25, 0.125, 1e-30];
        let n = 1000.0;
        for beta in [0.0, 0.4, 1.0] {
            let plain = probabilities.map(|p| (n * f64::from(p)).powf(-beta));
            let largest = plain.iter().copied().fold(0.0, f64::max);
            let found = importance_weights(&probabilities, beta);
            for (found, plain) in found.iter().zip(plain) {
                let error = f64::from(*found) - plain / largest;
                assert!(
                    error.abs() <= 1e-6 * plain / largest,
                    "beta {beta}: {error}"
                );
            }
            assert_eq!(found[3], 1.0, "the least likely row");
        }
        assert_eq!(importance_weights(&[0.25; 3], 0.7), [1.0; 3]);
    }
}
