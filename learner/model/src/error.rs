//! What can go wrong in the network: its configuration, its weights, its inputs.
//! Broken invariants of our own are assertions, not errors.

use thiserror::Error;

/// A fault of a configuration, a weights file or an input, or a failure inside candle.
#[derive(Debug, Error)]
pub enum ModelError {
    /// The configuration describes a network that cannot exist.
    #[error("model configuration: {0}")]
    Config(String),
    /// A parameter is missing, superfluous, of another type or shape, or not finite.
    #[error("parameter {name}: {problem}")]
    Parameter {
        /// The parameter's full name, for example `torso.conv1.weight`.
        name: String,
        /// What is wrong with it.
        problem: String,
    },
    /// The bytes are not a safetensors file.
    #[error("reading weights as safetensors: {0}")]
    Safetensors(#[from] safetensors::SafeTensorError),
    /// A frame, an action or a buffer does not fit the network.
    #[error("network input: {0}")]
    Input(String),
    /// A head was asked for that the configuration does not have.
    #[error("the network has no {0} head: its configuration leaves it out")]
    NoHead(&'static str),
    /// The network's output is not finite, so no action can be chosen from it.
    #[error("the network's output for row {row} of the batch is not finite")]
    NotFinite {
        /// Index of the first such row.
        row: usize,
    },
    /// A tensor operation failed.
    #[error("tensor operation: {0}")]
    Tensor(#[from] candle_core::Error),
}

impl ModelError {
    pub(crate) fn parameter(name: &str, problem: impl Into<String>) -> Self {
        Self::Parameter {
            name: name.to_owned(),
            problem: problem.into(),
        }
    }
}

/// Result of this crate's functions.
pub type Result<T> = std::result::Result<T, ModelError>;
