//! The non-homogeneous geometric rule (DRIML-ada): a walk along the stored actions for as long as they are expected.
//! It does not estimate the affinity, which comes from the learner.

use rand::Rng;

use super::affinity::Affinity;

/// Maximum difference between A and the probability that the walk continues, as a random f32 has 2^24 values.
pub const CONTINUE_ERROR: f64 = 1.0 / (1 << 24) as f64;

/// Walks i = 1..H along `actions` and stops at the first b = 0, b ~ Bernoulli(A_i), A_i = A[a_{t+i-1}, a_{t+i}].
///
/// `actions` are a_t, .., a_{t+H-1}; their number is H, at least 1. Result k in 1..=H with
/// P(k = i) = (1 - A_i) prod_{j<i} A_j for i < H, P(k = H) = prod_{j<H} A_j. A_H would not change k and is not read. Each A_i in
/// [0, 1] has an error of at most [`CONTINUE_ERROR`]; 0 and 1 are exact.
/// Source: Mazoure et al. 2020, the adaptive look-ahead of DRIML-ada.
pub fn draw_k(affinity: &Affinity, actions: &[u8], rng: &mut impl Rng) -> u32 {
    let stop = |pair: &[u8]| rng.random::<f32>() >= affinity.get(pair[0], pair[1]);
    match actions.windows(2).position(stop) {
        Some(walked) => walked as u32 + 1,
        None => actions.len() as u32,
    }
}
