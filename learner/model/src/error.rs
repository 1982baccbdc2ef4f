//! What can go wrong in the network: its configuration, its weights, its inputs.
//! Broken invariants of our own are assertions, not errors.

use thiserror::Error;

/// A fault of a configuration, a weights file or an input, or a failure inside candle.
#[derive(Debug, Error)]
#[allow(missing_docs, reason = "each message says it")]
pub enum ModelError {
    #[error("model configuration: {0}")]
    Config(String),
    #[error("parameter {name}: {problem}")]
    Parameter { name: String, problem: String },
    #[error("reading weights as safetensors: {0}")]
    Safetensors(#[from] safetensors::SafeTensorError),
    #[error("network input: {0}")]
    Input(String),
    #[error("the network has no {0} head: its configuration leaves it out")]
    NoHead(&'static str),
    /// No action can be chosen from it; of several such rows this is the first.
    #[error("the network's output for row {row} of the batch is not finite")]
    NotFinite { row: usize },
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
