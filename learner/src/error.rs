//! Why an update did not happen: the one error of everything that takes part in it.

/// Why an update, or the making of a learner, did not happen. But for [`UpdateError::Diverged`] parameters are then as they
/// were before.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs, reason = "each message says it")]
pub enum UpdateError {
    #[error("this batch cannot be learned from: {0}")]
    Batch(String),
    #[error("{0}; `driml presets` has settings that work")]
    Settings(String),
    /// Settings of the auxiliary loss that are at odds with each other.
    #[error("{0}")]
    AuxiliaryLoss(String),
    /// State that does not fit the network, as from another run's checkpoint.
    #[error("learner state does not fit: {0}")]
    State(String),
    #[error("{0} is not finite; the update is not taken")]
    NonFinite(String),
    /// The step itself left the finite numbers: this learner can neither continue nor be published or saved.
    #[error(
        "update {update} took {name} beyond the finite numbers; the learner cannot continue: resume from the newest checkpoint with \
         a learner.update.adam.lr below {lr:e}"
    )]
    Diverged { name: String, update: u64, lr: f64 },
    #[error(transparent)]
    Model(#[from] driml_model::ModelError),
    #[error(transparent)]
    Tensor(#[from] candle_core::Error),
}
