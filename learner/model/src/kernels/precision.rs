//! The precision of the network's matrix products.

use std::{fmt, str::FromStr};

use serde::{Deserialize, Serialize};

/// The type to which the operands of matrix products are rounded. Sums, losses, weights and moments are always f32.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Precision {
    /// 24 bits of significand: operands are not rounded.
    #[default]
    F32,
    /// 8 bits of significand and f32's exponents: operands are rounded to nearest, ties to even. Processors with bf16
    /// products flush operands, products and sums below 1.2e-38 to 0. An operand from 3.3962e38 on rounds to infinity.
    Bf16,
}

impl Precision {
    /// All precisions, the more exact one first.
    pub const ALL: [Self; 2] = [Self::F32, Self::Bf16];

    /// Largest error of a sum of `terms` products of f32 numbers, relative to the sum of the products' magnitudes, in addition
    /// to [`Precision::product_floor`]. It covers the rounding of both operands and of each f32 addition, in any order.
    ///
    /// The bound holds if the sum of the products' magnitudes is a finite f32. Source: Higham 2002, Accuracy
    /// and Stability of Numerical Algorithms, section 3.1.
    pub fn product_error(self, terms: usize) -> f64 {
        let operand: f64 = match self {
            Self::F32 => 0.0,
            // 2^-8.
            Self::Bf16 => 1.0 / 256.0,
        };
        let sums = (terms + 2) as f64 / 2f64.powi(24);
        (1.0 + operand).powi(2) * (1.0 + sums) - 1.0
    }

    /// Largest further error of such a sum through subnormal numbers, which are below 1.2e-38. In f32, it is the smallest subnormal
    /// number per product. In bf16, such operands, products and sums count as 0. `largest` is the magnitude of the largest operand.
    pub fn product_floor(self, terms: usize, largest: f64) -> f64 {
        let least = f64::from(f32::MIN_POSITIVE);
        match self {
            Self::F32 => terms as f64 * least / 2f64.powi(23),
            Self::Bf16 => terms as f64 * least * (2.0 + 2.0 * largest),
        }
    }
}

impl fmt::Display for Precision {
    /// Writes the name that settings and flags use.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.serialize(f)
    }
}

impl FromStr for Precision {
    type Err = String;

    fn from_str(name: &str) -> Result<Self, String> {
        let known = Self::ALL.into_iter().find(|it| it.to_string() == name);
        known.ok_or_else(|| format!("{name:?} is not a precision: use f32 or bf16"))
    }
}
