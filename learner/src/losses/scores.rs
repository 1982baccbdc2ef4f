//! Scores of an InfoNCE loss: dot products, scaled and softly clipped.

use candle_core::Tensor;
use driml_model::soft_clip;

/// Largest error of a clipped score, as a share of it.
pub const CLIP_ERROR: f64 = 2e-15;

/// Slopes below it are as good as 0: what is far enough below is given as 0.
pub const LEAST_SLOPE: f64 = 1e-290;

/// Largest error of a clipped score's slope, as a share of it: where the score saturates, the exponent `2 |x| / c` is known to its
/// own last place only. Below [`LEAST_SLOPE`] it is that share of it.
pub fn slope_error(score: f64, tanh_clip: f64) -> f64 {
    CLIP_ERROR + 1e-15 * (2.0 * score / tanh_clip).abs()
}

/// Dot products of every anchor with every candidate.
#[derive(Debug)]
pub struct Dots {
    /// [L, B, B]: location, anchor, candidate; L = 1 where both features are global.
    pub dots: Tensor,
    /// Numbers in each vector.
    pub width: usize,
}

/// How dot products become scores.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Scores {
    /// Factor on the dot products: `1 / sqrt(width)`.
    pub scale: f64,
    /// Bound c of the soft clip `c * tanh(x / c)`, in units of score, above 0.
    pub tanh_clip: f64,
}

impl Scores {
    /// Scores of dot products of vectors of `width` numbers.
    pub fn new(width: usize, tanh_clip: f64) -> Self {
        Self {
            scale: 1.0 / (width as f64).sqrt(),
            tanh_clip,
        }
    }

    /// The clipped score of a dot product.
    pub fn score(&self, dot: f32) -> f64 {
        self.clip(dot).0
    }

    /// The clipped score of a dot product, and its derivative by the dot product, as [`soft_clip`] has them: for scores and bounds
    /// from 1e-150 to 1e150 the score is right to [`CLIP_ERROR`], its slope to [`slope_error`] of the score before the clip.
    pub fn clip(&self, dot: f32) -> (f64, f64) {
        let (mut score, mut slope) = ([0.0], [0.0]);
        soft_clip(&[dot], self.scale, self.tanh_clip, &mut score, &mut slope);
        (score[0], slope[0])
    }
}
