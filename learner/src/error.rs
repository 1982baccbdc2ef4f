//! The error type of an update, shared by all modules that take part in it.

/// Why an update, or the creation of a learner, failed. Parameters are unchanged, except after [`UpdateError::Diverged`].
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
