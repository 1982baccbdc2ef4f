//! Why an update did not happen: the one error of everything that takes part in it.

/// Why an update, or the making of a learner, did not happen. But for [`UpdateError::Diverged`] parameters are then as they
/// were before.
#[derive(Debug, thiserror::Error)]
pub enum UpdateError {
    /// The batch is not one of this network's, or holds values that no world gives.
    #[error("this batch cannot be learned from: {0}")]
    Batch(String),
    /// A setting out of its range.
    #[error("{0}: that cannot work; start from a preset")]
    Settings(String),
    /// Settings of the auxiliary loss that are at odds with each other.
    #[error("{0}")]
    AuxiliaryLoss(String),
    /// State that does not fit the network, as from another run's checkpoint.
    #[error("learner state does not fit: {0}")]
    State(String),
    /// The arithmetic left the finite numbers.
    #[error("{what} is not finite; the update is not taken")]
    NonFinite {
        /// The first quantity in which it showed.
        what: String,
    },
    /// The step itself left the finite numbers: this learner can neither continue nor be published or saved.
    #[error(
        "update {update} took {name} beyond the finite numbers; the learner cannot continue: resume from the newest checkpoint with \
         a learner.update.adam.lr below {lr:e}"
    )]
    Diverged {
        /// The first parameter in which it showed.
        name: String,
        /// Number of the update, counted from 1.
        update: u64,
        /// The learning rate of that step.
        lr: f64,
    },
    /// The model refused its sizes, parameters or inputs.
    #[error(transparent)]
    Model(#[from] driml_model::ModelError),
    /// The tensor library refused.
    #[error(transparent)]
    Tensor(#[from] candle_core::Error),
}
