//! Why a world could not be made or stepped.

/// Why a world could not be made or stepped.
#[derive(Debug, thiserror::Error)]
pub enum EnvError {
    /// The settings cannot work; the message says which and what to do.
    #[error("{0}")]
    Config(String),
    /// Procgen's engine could not be had, or refused something.
    #[error(transparent)]
    Procgen(#[from] procgen_sys::ProcgenError),
    /// The process that is the world could not be started, or failed.
    #[error("{0}")]
    Exec(String),
    /// A step was asked for with an action that the world does not have, or with a buffer of the wrong length.
    #[error("{0}")]
    Step(String),
    /// This world cannot say how it stands, though nothing is wrong with it.
    #[error("{0}")]
    NotSaved(String),
    /// Bytes that are not a saved state of this world.
    #[error("no state of this world: {0}")]
    State(String),
}

/// An error of settings unless `holds`; `why` says which cannot work, and what would.
pub(crate) fn require(holds: bool, why: impl Into<String>) -> Result<(), EnvError> {
    match holds {
        true => Ok(()),
        false => Err(EnvError::Config(why.into())),
    }
}

impl EnvError {
    /// The error of a world that can never say how it stands.
    pub(crate) fn not_saved() -> Self {
        Self::NotSaved("this world's state cannot be saved".into())
    }
}
