//! The errors of this crate: invalid configurations, weights files and inputs.
//! Violated internal invariants are assertions, not errors.

use thiserror::Error;

/// An invalid configuration, weights file or input, or a failure inside candle.
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
    /// The output holds a NaN or an infinity, so no action can be chosen from this row. `row` is the first such row.
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

/// The result type of this crate's functions.
pub type Result<T> = std::result::Result<T, ModelError>;
