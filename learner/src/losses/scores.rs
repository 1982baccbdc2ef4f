//! Scores of an InfoNCE loss: dot products, scaled and softly clipped.

use candle_core::Tensor;

/// Dot products of every anchor with every candidate.
#[derive(Debug)]
pub struct Dots {
    /// [L, B, B]: location, anchor, candidate; L = 1 where both features are global.
    pub dots: Tensor,
    /// Numbers in each vector.
    pub rkhs: usize,
}

/// How dot products become scores.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Scores {
    /// Factor on the dot products: `1 / sqrt(rkhs)`.
    pub scale: f64,
    /// Bound c of the soft clip `c * tanh(x / c)`, in units of score, above 0.
    pub tanh_clip: f64,
}

impl Scores {
    /// Scores of dot products of vectors of `rkhs` numbers.
    pub fn new(rkhs: usize, tanh_clip: f64) -> Self {
        Self {
            scale: 1.0 / (rkhs as f64).sqrt(),
            tanh_clip,
        }
    }

    /// The clipped score of a dot product.
    pub fn score(&self, dot: f32) -> f64 {
        self.clip(dot).0
    }

    /// The clipped score of a dot product, and its derivative by the dot product.
    ///
    /// With `e = exp(-2 |x| / c)`: `tanh = (1 - e) / (1 + e)` and its slope `4 e / (1 + e)^2`, which, unlike
    /// `1 - tanh^2`, keeps its precision where the score saturates.
    pub(super) fn clip(&self, dot: f32) -> (f64, f64) {
        let x = f64::from(dot) * self.scale;
        let e = (-2.0 * x.abs() / self.tanh_clip).exp();
        let sum = 1.0 + e;
        let tanh = ((1.0 - e) / sum).copysign(x);
        (self.tanh_clip * tanh, self.scale * 4.0 * e / (sum * sum))
    }
}
