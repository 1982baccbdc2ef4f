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
    #[error(transparent)]
    Exec(Box<ExecError>),
    /// A step was asked for with an action that the world does not have.
    #[error(
        "action {action} of environment {env} is out of range: this world has {num_actions} actions"
    )]
    ActionOutOfRange {
        /// The environment, counted from 0.
        env: usize,
        /// The action given.
        action: u8,
        /// The world's number of actions; valid ones are below it.
        num_actions: usize,
    },
    /// This world cannot say how it stands.
    #[error("this world's state cannot be saved")]
    NotSaved,
    /// Bytes that are not a saved state of this world.
    #[error("no state of this world: {0}")]
    State(String),
    /// A step was asked for with a buffer of the wrong length.
    #[error("{name} has {got} entries, but the world has {num_envs} environments")]
    BufferLength {
        /// Which buffer.
        name: &'static str,
        /// Its entries.
        got: usize,
        /// The world's environments.
        num_envs: usize,
    },
}

impl EnvError {
    /// Whether it says that a world cannot say how it stands, though nothing is wrong with it.
    pub fn is_not_saved(&self) -> bool {
        match self {
            Self::NotSaved => true,
            Self::Exec(error) => matches!(error.fault, Fault::NotSaved(_)),
            _ => false,
        }
    }
}

impl From<ExecError> for EnvError {
    fn from(error: ExecError) -> Self {
        Self::Exec(Box::new(error))
    }
}

/// Why a world's process cannot be used.
#[derive(Debug, thiserror::Error)]
#[error("the world `{command}` {fault}{words}")]
pub struct ExecError {
    /// The command, as `--env` has it after `exec:`.
    pub command: String,
    /// What is wrong.
    pub fault: Fault,
    /// The last lines that it wrote to stderr, as the message ends with them; empty if it wrote none.
    pub words: String,
}

/// What is wrong with a world's process.
#[derive(Debug, thiserror::Error)]
pub enum Fault {
    /// It ended by itself, or was killed as it did not answer.
    #[error("{0}")]
    Dead(String),
    /// It offers to save its state, and found that it cannot: why, in its own words.
    #[error("cannot save its state: {0}")]
    NotSaved(String),
    /// It is not the world that was asked for, does what no world may, or the operating system reports an error.
    #[error("{0}")]
    Other(String),
}
