//! The errors of acting. The errors of delivery are in `delivery`, those of pulling weights in `weights`.

use driml_envs::EnvError;
use driml_model::ModelError;
use driml_protocol::config::ConfigError;

/// A world, a policy and settings that do not fit together, or the failure of one of them.
#[derive(Debug, thiserror::Error)]
pub enum ActError {
    /// A table of the settings is missing or malformed, or a value is invalid.
    #[error(transparent)]
    Settings(#[from] ConfigError),
    /// The network's settings are invalid, its weights or input do not fit, or it fails.
    #[error(transparent)]
    Network(#[from] ModelError),
    /// The world cannot be stepped.
    #[error(transparent)]
    World(#[from] EnvError),
    /// The world cannot be built.
    #[error("making the world {world}")]
    BuildWorld {
        /// The world's name in the settings.
        world: String,
        /// The world's error.
        source: EnvError,
    },
    /// Settings that do not fit the world, the network or the actor's number, or episodes that do not end.
    #[error("{0}")]
    Other(String),
}
