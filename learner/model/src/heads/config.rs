//! How the C51 head is made: as one linear layer, or as two streams that share the actions out.
//! It computes nothing.

use serde::{Deserialize, Serialize};

/// How the C51 head is made, the table `[model.head]`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct HeadConfig {
    /// A stream for the state's value and one for what each action is better than the mean of all, added before the softmax.
    /// Source: Wang et al. 2016; per atom as in Hessel et al. 2018.
    #[serde(default)]
    pub dueling: bool,
}

impl HeadConfig {
    /// One linear layer.
    pub const PLAIN: Self = Self { dueling: false };

    /// Whether it is one linear layer: what it then says need not be said.
    #[allow(clippy::trivially_copy_pass_by_ref, reason = "serde asks by reference")]
    pub(crate) fn is_plain(&self) -> bool {
        *self == Self::PLAIN
    }
}
