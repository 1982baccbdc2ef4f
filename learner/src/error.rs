//! The error type of an update, shared by all modules that take part in it.

/// Why settings cannot work, or an update failed. Parameters are unchanged, except after [`UpdateError::Diverged`].
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs, reason = "each message says it")]
pub enum UpdateError {
    #[error("this batch cannot be learned from: {0}")]
    Batch(String),
    #[error("{0}; `driml presets` has settings that work")]
    Settings(String),
    /// Settings of the auxiliary loss contradict each other.
    #[error("{0}")]
    AuxiliaryLoss(String),
    /// Settings, pairs of actions or a saved estimate of the affinity are invalid.
    #[error("action affinity: {0}")]
    Affinity(String),
    /// A table of the settings is missing or does not fit, or one of its values is invalid.
    #[error(transparent)]
    Config(#[from] driml_protocol::config::ConfigError),
    #[error(
        "the [model] table's sizes do not follow from [run] and [input]: write the settings anew with `driml train`"
    )]
    ModelSizes,
    /// The state does not fit the network, for example because it is from another run's checkpoint.
    #[error("learner state does not fit: {0}")]
    State(String),
    #[error("{0} is not finite; the update was not applied")]
    NonFinite(String),
    /// The optimiser step made a parameter or moment infinite or NaN. This learner can neither continue nor publish nor save.
    #[error(
        "update {update} made {name} infinite or NaN; the learner cannot continue: resume from the newest checkpoint with \
         a learner.update.adam.lr below {lr:e}"
    )]
    Diverged { name: String, update: u64, lr: f64 },
    #[error(transparent)]
    Model(#[from] driml_model::ModelError),
    #[error(transparent)]
    Tensor(#[from] candle_core::Error),
}

/// The result type of this crate's functions.
pub type Result<T, E = UpdateError> = std::result::Result<T, E>;
