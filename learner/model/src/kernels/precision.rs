//! In which numbers the products of the network are computed.

use std::{fmt, str::FromStr};

use serde::{Deserialize, Serialize};

/// What the operands of matrix products are rounded to. Sums, losses, weights and moments are f32 in either.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Precision {
    /// 24 bits of significand: operands as they are.
    #[default]
    F32,
    /// 8 bits of significand, the exponents of f32: operands rounded to nearest, ties to even.
    Bf16,
}

impl Precision {
    /// All of them.
    pub const ALL: [Self; 2] = [Self::F32, Self::Bf16];

    /// The name that settings and flags use.
    pub const fn name(self) -> &'static str {
        match self {
            Self::F32 => "f32",
            Self::Bf16 => "bf16",
        }
    }
}

impl fmt::Display for Precision {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

/// Not the name of a precision.
#[derive(Debug, thiserror::Error)]
#[error("{0:?} is no precision: take f32 or bf16")]
pub struct UnknownPrecision(String);

impl FromStr for Precision {
    type Err = UnknownPrecision;

    fn from_str(name: &str) -> Result<Self, UnknownPrecision> {
        Self::ALL
            .into_iter()
            .find(|precision| precision.name() == name)
            .ok_or_else(|| UnknownPrecision(name.to_owned()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_read_back() {
        for precision in Precision::ALL {
            assert_eq!(
                precision.to_string().parse::<Precision>().unwrap(),
                precision
            );
        }
        let error = "f16".parse::<Precision>().unwrap_err().to_string();
        assert!(error.contains("take f32 or bf16"), "{error}");
    }
}
