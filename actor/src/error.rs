//! Why an actor cannot act. What hinders it to deliver is in `delivery`, and to get weights in `weights`.

use driml_envs::EnvError;
use driml_model::ModelError;

use crate::schedule::BeyondLadder;

/// A world, a policy or settings that do not go together, or the failure of one of them.
#[derive(Debug, thiserror::Error)]
pub enum ActError {
    /// The network refuses its weights or its input, or fails.
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
    /// The world has another shape than the run's settings.
    #[error(
        "the world {world} gives (height, width, channels, actions) {given:?}, the run spec promises {promised:?}: \
         write the run's settings anew with `driml train`"
    )]
    OtherShape {
        /// The world's name, as settings have it.
        world: String,
        /// What it gives.
        given: (u32, u32, u32, u32),
        /// What the run spec says.
        promised: (u32, u32, u32, u32),
    },
    /// More actions than the wire has numbers for.
    #[error("{actions} actions: a world has at most 255")]
    TooManyActions {
        /// The network's.
        actions: usize,
    },
    /// An actor for which the ladder has no epsilon.
    #[error(transparent)]
    BeyondLadder(#[from] BeyondLadder),
    /// Episodes that do not end.
    #[error(
        "only {ended} of {wanted} episodes ended within {steps_max} steps of each copy: ask for fewer"
    )]
    EndlessEpisodes {
        /// Episodes that ended.
        ended: usize,
        /// Episodes that were asked for.
        wanted: usize,
        /// Steps that each copy made.
        steps_max: u64,
    },
}
