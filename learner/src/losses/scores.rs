//! Scores of an InfoNCE loss: dot products, scaled and softly clipped.

use candle_core::Tensor;
use driml_model::soft_clip;

/// Largest relative error of a clipped score.
pub const CLIP_ERROR: f64 = 2e-15;

/// Derivatives below this are as good as 0; far smaller ones are returned as 0.
pub const LEAST_SLOPE: f64 = 1e-290;

/// Largest relative error of a clipped score's derivative. If the score saturates, this is the rounding error of the exponent
/// `2 |x| / c`. Below [`LEAST_SLOPE`], the error is relative to [`LEAST_SLOPE`].
pub fn slope_error(score: f64, tanh_clip: f64) -> f64 {
    CLIP_ERROR + 1e-15 * (2.0 * score / tanh_clip).abs()
}

/// Dot products of every anchor with every candidate.
#[derive(Debug)]
pub struct DotProducts {
    /// [L, B, B]: location, anchor, candidate; L = 1 where both features are global.
    pub values: Tensor,
    /// Length of each vector.
    pub width: usize,
}

/// The scale and the soft clip that turn dot products into scores.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ScoreClip {
    /// Factor on the dot products: `1 / sqrt(width)`.
    pub scale: f64,
    /// Bound c of the soft clip `c * tanh(x / c)`, in units of score, above 0.
    pub tanh_clip: f64,
}

impl ScoreClip {
    /// The scale and the clip for dot products of vectors of length `width`.
    pub fn new(width: usize, tanh_clip: f64) -> Self {
        Self {
            scale: 1.0 / (width as f64).sqrt(),
            tanh_clip,
        }
    }

    /// The clipped score of a dot product.
    pub fn score(&self, dot: f32) -> f64 {
        self.score_and_slope(dot).0
    }

    /// The clipped score of a dot product and its derivative by the dot product, from [`soft_clip`]. For scores and bounds from 1e-150 to
    /// 1e150, the score is accurate to [`CLIP_ERROR`], and the derivative to [`slope_error`] of the score before the clip.
    pub fn score_and_slope(&self, dot: f32) -> (f64, f64) {
        let (mut score, mut slope) = ([0.0], [0.0]);
        soft_clip(&[dot], self.scale, self.tanh_clip, &mut score, &mut slope);
        (score[0], slope[0])
    }
}
