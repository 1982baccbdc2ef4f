//! The structure of the C51 head: one linear layer or two streams, with or without noise.
//! This module computes nothing.

use serde::{Deserialize, Serialize};

use crate::error::{ModelError, Result};

/// Layer name of a plain head, then those of a dueling head's two streams.
pub(crate) const HEAD: &str = "head";
pub(crate) const VALUE: &str = "head.value";
pub(crate) const ADVANTAGE: &str = "head.advantage";

/// Largest sigma_0; a configuration beyond it is rejected.
const NOISY_SIGMA_MAX: f64 = 100.0;

/// The structure of the C51 head: the table `[model.head]`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct HeadConfig {
    /// Whether the head is dueling: a stream for the state's value and one for each action's advantage over
    /// the mean, added before the softmax. Source: Wang et al. 2016; per atom as in Hessel et al. 2018.
    #[serde(default)]
    pub dueling: bool,
    /// sigma_0 of noisy layers, above 0 and at most 100: the initial scale of the weights' noise, in units of
    /// 1 / sqrt(inputs). Absent: no noisy layers. Source: Fortunato et al. 2018, who use 0.5.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub noisy_sigma: Option<f64>,
}

impl HeadConfig {
    /// One linear layer without noise.
    pub const PLAIN: Self = Self {
        dueling: false,
        noisy_sigma: None,
    };
    /// Two streams of noisy layers. Source: Hessel et al. 2018.
    pub const RAINBOW: Self = Self {
        dueling: true,
        noisy_sigma: Some(0.5),
    };

    pub(crate) fn validate(&self) -> Result<()> {
        match self.noisy_sigma {
            Some(sigma) if !(sigma > 0.0 && sigma <= NOISY_SIGMA_MAX) => {
                Err(ModelError::Config(format!(
                    "head.noisy_sigma is {sigma}, must be above 0 and at most {NOISY_SIGMA_MAX}"
                )))
            }
            _ => Ok(()),
        }
    }

    /// Whether the head is one linear layer without noise. Serialised settings then omit the table.
    #[allow(clippy::trivially_copy_pass_by_ref, reason = "serde asks by reference")]
    pub(crate) fn is_plain(&self) -> bool {
        *self == Self::PLAIN
    }
}
