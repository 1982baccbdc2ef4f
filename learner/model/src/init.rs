//! Initial weights and biases from a seeded generator: orthogonal matrices, or PyTorch's uniform distribution.
//! `config` decides how each layer is drawn, together with its shape.
//!
//! The caller passes the generator in. Draws follow a fixed order, so the same seed gives the same weights on
//! the same machine. The last bits depend on the C library's logarithm and cosine.

use rand_chacha::{ChaCha8Rng, rand_core::RngCore};

/// Gain for layers before a ReLU: sqrt(2).
const RELU_GAIN: f64 = std::f64::consts::SQRT_2;

/// Partial sums of a dot product, computed side by side.
const LANES: usize = 8;

/// How the initial weight and bias of a layer are drawn.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Initializer {
    /// Weight orthogonal with gain sqrt(2), where a convolution counts as [out, in * k * k]. Bias 0.
    Orthogonal,
    /// Weight and bias uniform on +-1/sqrt(fan_in), PyTorch's default for a linear layer.
    Uniform,
}

impl Initializer {
    /// Draws a layer's initial weight, row-major, of shape [out, in] or [out, in, k, k].
    pub(crate) fn draw_weight(self, shape: &[usize], rng: &mut ChaCha8Rng) -> Vec<f32> {
        let (rows, fan_in) = (shape[0], fan_in(shape));
        match self {
            Self::Orthogonal => draw_orthogonal(rows, fan_in, RELU_GAIN, rng),
            Self::Uniform => draw_uniform_within(fan_in, rows * fan_in, rng),
        }
    }

    /// Draws the initial bias [out] of a layer whose weight has this shape.
    pub(crate) fn draw_bias(self, weight: &[usize], rng: &mut ChaCha8Rng) -> Vec<f32> {
        match self {
            Self::Orthogonal => vec![0.0; weight[0]],
            Self::Uniform => draw_uniform_within(fan_in(weight), weight[0], rng),
        }
    }
}

/// The number of inputs to one output of a layer.
fn fan_in(weight: &[usize]) -> usize {
    weight[1..].iter().product()
}

/// Draws `len` numbers uniform on +-1/sqrt(fan_in).
fn draw_uniform_within(fan_in: usize, len: usize, rng: &mut ChaCha8Rng) -> Vec<f32> {
    let bound = 1.0 / (fan_in as f64).sqrt();
    (0..len)
        .map(|_| ((2.0 * draw_uniform(rng) - 1.0) * bound) as f32)
        .collect()
}

/// Draws a random matrix [rows, cols] whose rows, or columns if they are fewer, are orthogonal and of length `gain`.
///
/// W W^T = gain^2 I if rows <= cols, else W^T W = gain^2 I, uniformly distributed among such matrices.
/// Gram-Schmidt makes normal vectors orthonormal in f64, twice, because one pass loses digits. Source: Saxe
/// et al. 2014; PyTorch's `orthogonal_` gives the same distribution.
fn draw_orthogonal(rows: usize, cols: usize, gain: f64, rng: &mut ChaCha8Rng) -> Vec<f32> {
    let (count, len) = (rows.min(cols), rows.max(cols));
    let mut basis: Vec<Vec<f64>> = Vec::with_capacity(count);
    for _ in 0..count {
        let mut vector = draw_normals(len, rng);
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

pub(crate) fn draw_normals(len: usize, rng: &mut ChaCha8Rng) -> Vec<f64> {
    let pairs = (0..len.div_ceil(2)).flat_map(|_| draw_normal_pair(rng));
    pairs.take(len).collect()
}

/// Draws two independent standard normal numbers, by the Box-Muller method.
fn draw_normal_pair(rng: &mut ChaCha8Rng) -> [f64; 2] {
    // In (0, 1], so that the logarithm is finite.
    let radius = (-2.0 * (1.0 - draw_uniform(rng)).ln()).sqrt();
    let (sin, cos) = (std::f64::consts::TAU * draw_uniform(rng)).sin_cos();
    [radius * cos, radius * sin]
}

/// Draws a number uniform on [0, 1) with 53 bits.
fn draw_uniform(rng: &mut ChaCha8Rng) -> f64 {
    (rng.next_u64() >> 11) as f64 / (1u64 << 53) as f64
}

#[cfg(test)]
mod tests {
    use rand_chacha::rand_core::SeedableRng;

    use super::*;

    #[test]
    fn uniform_weights_and_biases_have_the_bound_and_variance_of_fan_in() {
        let mut rng = ChaCha8Rng::seed_from_u64(6);
        for shape in [&[300, 100][..], &[40, 25, 2, 2]] {
            let weight = Initializer::Uniform.draw_weight(shape, &mut rng);
            let bias: Vec<f32> = (0..40)
                .flat_map(|_| Initializer::Uniform.draw_bias(shape, &mut rng))
                .collect();
            assert_eq!(weight.len(), shape.iter().product::<usize>());
            assert_eq!(bias.len(), 40 * shape[0]);
            for values in [weight, bias] {
                let largest = values.iter().fold(0f32, |max, value| max.max(value.abs()));
                assert!(largest <= 0.1 && largest > 0.0995, "{largest}");
                let len = values.len() as f64;
                let moment = |power| {
                    let powers = values.iter().map(|&v| f64::from(v).powi(power));
                    powers.sum::<f64>() / len
                };
                // The variance of U(-0.1, 0.1) is 0.01 / 3; five standard errors.
                let error = (0.01f64 / 3.0 / len).sqrt();
                assert!(moment(1).abs() < 5.0 * error, "mean {}", moment(1));
                let spread = moment(2) / (0.01 / 3.0);
                let error = (0.8 / len).sqrt();
                assert!((spread - 1.0).abs() < 5.0 * error, "variance {spread}");
            }
        }
    }

    #[test]
    fn a_layer_that_starts_orthogonal_has_no_bias_and_draws_none() {
        let (mut one, mut other) = (ChaCha8Rng::seed_from_u64(7), ChaCha8Rng::seed_from_u64(7));
        let bias = Initializer::Orthogonal.draw_bias(&[5, 3], &mut one);
        assert_eq!(bias, [0.0; 5]);
        assert_eq!(one.next_u64(), other.next_u64());
        // A kernel is a matrix [out, in * k * k].
        let kernel = Initializer::Orthogonal.draw_weight(&[4, 3, 2, 2], &mut one);
        let matrix = draw_orthogonal(4, 12, RELU_GAIN, &mut other);
        assert_eq!(kernel, matrix);
    }

    #[test]
    fn entries_have_mean_zero_and_the_variance_of_a_rotation() {
        let weight = draw_orthogonal(64, 1024, 1.0, &mut ChaCha8Rng::seed_from_u64(5));
        let mean = weight.iter().sum::<f32>() / weight.len() as f32;
        // Standard error of the mean of 65,536 entries of variance 1/1024.
        assert!(mean.abs() < 4.0 / 1024f32.sqrt() / 256.0, "{mean}");
        let squares: f32 = weight.iter().map(|w| w * w).sum();
        assert!((squares - 64.0).abs() < 1e-3, "64 unit rows: {squares}");
    }
}
