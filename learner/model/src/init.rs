//! Initial weights: orthogonal matrices from a seeded generator.
//! Biases are 0 and drawn by nobody.
//!
//! The source of randomness is passed in and used in a fixed way, so the same seed gives the same weights on the same
//! machine (the last bits depend on the C library's logarithm and cosine).

use rand_chacha::{ChaCha8Rng, rand_core::RngCore};

/// Gain for layers before a ReLU: sqrt(2).
pub(crate) const RELU_GAIN: f64 = std::f64::consts::SQRT_2;

/// Partial sums of a dot product; that many are computed side by side.
const LANES: usize = 8;

/// A random matrix [rows, cols] whose shorter side's vectors are orthogonal and of length `gain`.
///
/// W W^T = gain^2 I if rows <= cols, else W^T W = gain^2 I, uniformly distributed among such matrices: normal vectors made
/// orthonormal one after the other, in f64 and twice, as once loses digits. Source: Saxe et al. 2014; PyTorch's
/// `orthogonal_` gives the same distribution.
pub(crate) fn orthogonal(rows: usize, cols: usize, gain: f64, rng: &mut ChaCha8Rng) -> Vec<f32> {
    let (count, len) = (rows.min(cols), rows.max(cols));
    let mut basis: Vec<Vec<f64>> = Vec::with_capacity(count);
    for _ in 0..count {
        let mut vector: Vec<f64> = (0..len.div_ceil(2))
            .flat_map(|_| normal_pair(rng))
            .take(len)
            .collect();
        for _ in 0..2 {
            for earlier in &basis {
                let overlap = dot(earlier, &vector);
                for (value, earlier) in vector.iter_mut().zip(earlier) {
                    *value -= overlap * earlier;
                }
            }
            let norm = dot(&vector, &vector).sqrt();
            vector.iter_mut().for_each(|value| *value /= norm);
        }
        basis.push(vector);
    }
    let mut weight = vec![0.0; rows * cols];
    for (index, vector) in basis.iter().enumerate() {
        for (position, value) in vector.iter().enumerate() {
            let at = if rows <= cols {
                index * cols + position
            } else {
                position * cols + index
            };
            weight[at] = (gain * value) as f32;
        }
    }
    weight
}

fn dot(a: &[f64], b: &[f64]) -> f64 {
    let (a_lanes, a_rest) = a.as_chunks::<LANES>();
    let (b_lanes, b_rest) = b.as_chunks::<LANES>();
    let mut sums = [0.0; LANES];
    for (a, b) in a_lanes.iter().zip(b_lanes) {
        for ((sum, a), b) in sums.iter_mut().zip(a).zip(b) {
            *sum += a * b;
        }
    }
    let rest: f64 = a_rest.iter().zip(b_rest).map(|(a, b)| a * b).sum();
    sums.iter().sum::<f64>() + rest
}

/// Two independent standard normal numbers, by Box and Muller's method.
fn normal_pair(rng: &mut ChaCha8Rng) -> [f64; 2] {
    // In (0, 1], so that the logarithm is finite.
    let radius = (-2.0 * (1.0 - uniform(rng)).ln()).sqrt();
    let (sin, cos) = (std::f64::consts::TAU * uniform(rng)).sin_cos();
    [radius * cos, radius * sin]
}

/// Uniform on [0, 1) with 53 bits.
fn uniform(rng: &mut ChaCha8Rng) -> f64 {
    (rng.next_u64() >> 11) as f64 / (1u64 << 53) as f64
}

#[cfg(test)]
mod tests {
    use rand_chacha::rand_core::SeedableRng;

    use super::*;

    /// Gram matrix of the shorter side.
    fn largest_error(rows: usize, cols: usize) -> f64 {
        let weight = orthogonal(rows, cols, RELU_GAIN, &mut ChaCha8Rng::seed_from_u64(3));
        let count = rows.min(cols);
        let vector = |index: usize| -> Vec<f64> {
            let entries: Vec<f64> = weight.iter().map(|&value| f64::from(value)).collect();
            if rows <= cols {
                entries[index * cols..][..cols].to_vec()
            } else {
                entries.into_iter().skip(index).step_by(cols).collect()
            }
        };
        let vectors: Vec<Vec<f64>> = (0..count).map(vector).collect();
        let mut largest: f64 = 0.0;
        for i in 0..count {
            for j in 0..count {
                let wanted = if i == j { 2.0 } else { 0.0 };
                largest = largest.max((dot(&vectors[i], &vectors[j]) - wanted).abs());
            }
        }
        largest
    }

    #[test]
    fn wide_tall_and_square_matrices_are_orthogonal() {
        for (rows, cols) in [(32, 192), (75, 24), (40, 40), (1, 5), (5, 1), (1, 1)] {
            let error = largest_error(rows, cols);
            assert!(error < 1e-5, "{rows}x{cols}: {error}");
        }
    }

    #[test]
    fn entries_have_mean_zero_and_the_variance_of_a_rotation() {
        let weight = orthogonal(64, 1024, 1.0, &mut ChaCha8Rng::seed_from_u64(5));
        let mean = weight.iter().sum::<f32>() / weight.len() as f32;
        // Standard error of the mean of 65,536 entries of variance 1/1024.
        assert!(mean.abs() < 4.0 / 1024f32.sqrt() / 256.0, "{mean}");
    }
}
