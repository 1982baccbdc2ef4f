//! The menu of auxiliary objectives: what an agent learns beside the return.
//! An item makes losses from features; it neither weighs them against C51 nor takes a step.

pub mod dim;

use dim::Dim;

/// The auxiliary objective of an agent.
#[derive(Clone, Debug, PartialEq)]
pub enum Auxiliary {
    /// The agent learns the return alone: no second pass, no heads.
    None,
    /// Deep InfoMax between s_t and s_{t+k}.
    Dim(Dim),
}

impl Auxiliary {
    /// Whether batches must bring s_{t+k}.
    pub const fn needs_positives(&self) -> bool {
        match self {
            Self::None => false,
            Self::Dim(_) => true,
        }
    }
}
