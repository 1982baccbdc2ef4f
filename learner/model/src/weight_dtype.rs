//! The scalar types of a weights file: f32, or 2-byte types for weights that are sent often.
//! This module knows no parameter by name.

use std::fmt;

use half::{bf16, f16};
use safetensors::tensor::Dtype;
use serde::{Deserialize, Serialize};

/// The type of the scalars in a weights file. Rounding is to nearest, ties to even.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum WeightDtype {
    /// f32, unchanged, 4 bytes each.
    #[default]
    F32,
    /// IEEE half precision: 11 bits of significand, up to 65,504, 2 bytes each.
    F16,
    /// bfloat16: 8 bits of significand, up to 3.4e38, 2 bytes each.
    Bf16,
}

impl fmt::Display for WeightDtype {
    /// Writes the name that settings use.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.serialize(f)
    }
}

impl WeightDtype {
    /// Largest error of a stored scalar, relative to the scalar or to [`WeightDtype::min_normal`], whichever is larger.
    pub const fn rounding_error(self) -> f64 {
        match self {
            Self::F32 => 0.0,
            Self::F16 => f16::EPSILON.to_f64_const() / 2.0,
            Self::Bf16 => bf16::EPSILON.to_f64_const() / 2.0,
        }
    }

    /// The smallest normal number. Smaller numbers have a fixed spacing: 2 * [`WeightDtype::rounding_error`] * `min_normal`.
    pub const fn min_normal(self) -> f32 {
        match self {
            Self::F32 | Self::Bf16 => f32::MIN_POSITIVE,
            Self::F16 => f16::MIN_POSITIVE.to_f32_const(),
        }
    }

    /// The largest number. A larger one is rejected, even if it would round to this one.
    pub const fn largest(self) -> f32 {
        match self {
            Self::F32 => f32::MAX,
            Self::F16 => f16::MAX.to_f32_const(),
            Self::Bf16 => bf16::MAX.to_f32_const(),
        }
    }

    /// The type's name in a safetensors file.
    pub(crate) const fn safetensors_dtype(self) -> Dtype {
        match self {
            Self::F32 => Dtype::F32,
            Self::F16 => Dtype::F16,
            Self::Bf16 => Dtype::BF16,
        }
    }

    /// Bytes of one scalar.
    pub const fn bytes(self) -> usize {
        match self {
            Self::F32 => 4,
            Self::F16 | Self::Bf16 => 2,
        }
    }

    /// Encodes `values` as little-endian bytes. Returns the index of the first value that is too large for the type.
    pub(crate) fn encode(self, values: &[f32]) -> Result<Vec<u8>, usize> {
        let largest = self.largest();
        if let Some(at) = values.iter().position(|value| value.abs() > largest) {
            return Err(at);
        }
        let all = values.iter();
        Ok(match self {
            Self::F32 => all.flat_map(|x| x.to_le_bytes()).collect(),
            Self::F16 => all.flat_map(|&x| f16::from_f32(x).to_le_bytes()).collect(),
            Self::Bf16 => all.flat_map(|&x| bf16::from_f32(x).to_le_bytes()).collect(),
        })
    }
}

/// Decodes the scalars of a tensor; `None` if `dtype` is not one of [`WeightDtype`].
pub(crate) fn decode(dtype: Dtype, bytes: &[u8]) -> Option<Vec<f32>> {
    let halves = |value: fn([u8; 2]) -> f32| {
        let (halves, _) = bytes.as_chunks::<2>();
        halves.iter().map(|&bytes| value(bytes)).collect()
    };
    match dtype {
        Dtype::F32 => {
            let (scalars, _) = bytes.as_chunks::<4>();
            let scalars = scalars.iter().map(|&bytes| f32::from_le_bytes(bytes));
            Some(scalars.collect())
        }
        Dtype::F16 => Some(halves(|bytes| f16::from_le_bytes(bytes).to_f32())),
        Dtype::BF16 => Some(halves(|bytes| bf16::from_le_bytes(bytes).to_f32())),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Decoded values are the nearest numbers; the property table of `driml experiment stability` covers that for all types.
    #[test]
    fn what_would_be_infinite_is_refused_and_so_are_other_types() {
        assert_eq!(WeightDtype::F16.encode(&[1.0, 65_519.0]), Err(1));
        assert_eq!(WeightDtype::Bf16.encode(&[f32::MAX]), Err(0));
        assert!(WeightDtype::F32.encode(&[f32::MAX]).is_ok());
        assert_eq!(decode(Dtype::F64, &[0; 8]), None);
    }
}
