//! The errors of worlds: bad settings, failed engines and processes, steps and saved states that do not fit.

/// Why a world could not be made, stepped, saved or loaded.
#[derive(Debug, thiserror::Error)]
pub enum EnvError {
    /// The settings cannot work; the message says which and what to do.
    #[error("{0}")]
    Config(String),
    /// Procgen's engine could not be installed or loaded, or rejected a call.
    #[error(transparent)]
    Procgen(#[from] procgen_sys::ProcgenError),
    /// The process of an `exec` world could not be started, or failed.
    #[error("{0}")]
    Exec(String),
    /// A step has an action that the world does not have, or a buffer of the wrong length.
    #[error("{0}")]
    Step(String),
    /// This world cannot save its state, but still works.
    #[error("{0}")]
    NotSaved(String),
    /// Bytes that are not a saved state of this world.
    #[error("the bytes are not a state of this world: {0}")]
    State(String),
}

/// Returns [`EnvError::Config`] unless `holds`; `why` names the invalid setting and says which values work.
pub(crate) fn require(holds: bool, why: impl Into<String>) -> Result<(), EnvError> {
    match holds {
        true => Ok(()),
        false => Err(EnvError::Config(why.into())),
    }
}

impl EnvError {
    /// The error of a world that can never save its state.
    pub(crate) fn not_saved() -> Self {
        Self::NotSaved("this world's state cannot be saved".into())
    }
}
