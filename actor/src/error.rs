//! Why an actor cannot act. What hinders it to deliver is in `delivery`, and to get weights in `weights`.

use driml_envs::EnvError;
use driml_model::ModelError;
use driml_protocol::config::ConfigError;

/// A world, a policy or settings that do not go together, or the failure of one of them.
#[derive(Debug, thiserror::Error)]
pub enum ActError {
    /// A table of the settings is missing or does not fit, or a value cannot work.
    #[error(transparent)]
    Settings(#[from] ConfigError),
    /// The network cannot exist, refuses its weights or its input, or fails.
    #[error(transparent)]
    Network(#[from] ModelError),
    /// The world cannot be stepped.
    #[error(transparent)]
    World(#[from] EnvError),
    /// The world cannot be made.
    #[error("making the world {world}")]
    NoWorld {
        /// The world's name, as settings have it.
        world: String,
        /// What the world says.
        source: EnvError,
    },
    /// Settings that do not go together with the world, the network or the actor's number, or episodes that do not end.
    #[error("{0}")]
    Other(String),
}
