//! The worlds: no network, no tensors, deterministic from a seed.
//! Stepping policies, recording and statistics live in `driml-actor`.
//!
//! Every world is N copies of a game behind one trait, [`Environment`]: `observe` writes the current frames,
//! `step` takes an action for each copy. A copy that ends starts again by itself.
//!
//! | name | frame | actions | what for |
//! | --- | --- | --- | --- |
//! | `procgen:GAME` | 64 x 64 x 3 | 15 | the benchmark: Procgen's own engine, loaded at run time |
//! | `mspacman` | 21 x 19 x 3 | 5 | continual learning and predictability: four ghosts, lethal by choice |
//! | `ising` | 84 x 84 x 1 | 1 | an Ising patch in noise: what can be predicted and what cannot |
//! | `chain` | settable x 1 | 3 | a corridor with a known best return, for fast learning tests |
//!
//! [`WorldConfig`] holds the settings of any of them (`kind` says which), [`make_world`] builds it, and [`WorldName`]
//! reads the names above from a command line. [`FrameStack`] stacks frames without crossing the end of an episode.
//!
//! ```
//! use driml_envs::{ChainConfig, FrameStack, StepEnd, WorldConfig, make_world};
//!
//! let config = WorldConfig::Chain(ChainConfig {
//!     cells: 8, height: 12, width: 12, step_limit: 30, reward_left: 0.1, reward_right: 1.0,
//! });
//! let num_envs = 2;
//! let mut world = make_world(&config, num_envs, 7, 1)?;
//! let mut stack = FrameStack::new(world.frame_shape(), 4, num_envs)?;
//! let mut frames = vec![0; num_envs * world.frame_shape().bytes()];
//! let (mut rewards, mut ends) = (vec![0.0; num_envs], vec![StepEnd::Running; num_envs]);
//! let mut first = vec![true; num_envs];
//! for _ in 0..10 {
//!     world.observe(&mut frames);
//!     stack.push(&frames, &first);
//!     world.step(&[1, 2], &mut rewards, &mut ends)?;
//!     first = ends.iter().map(|&end| end != StepEnd::Running).collect();
//! }
//! # Ok::<(), driml_envs::EnvError>(())
//! ```
//!
//! Copy i of a world depends on the seed, i and its own actions only, not on how many copies there are. No numbers that
//! affect learning have defaults here: settings are written in full, and unknown keys are rejected.

#![cfg_attr(test, allow(clippy::unwrap_used, clippy::print_stdout))]

mod config;
mod copies;
mod environment;
mod frame_stack;
mod ising;
mod markov_chain;
mod pacman;
mod procgen;
mod world;

pub use config::{WorldConfig, WorldName, WorldNameError};
pub use environment::{Environment, FrameShape, StepEnd};
pub use frame_stack::FrameStack;
pub use ising::{Boundary, IsingConfig, IsingLattice, IsingWorld};
pub use markov_chain::{ChainConfig, ChainWorld, optimal_discounted_return, optimal_return};
pub use pacman::{IsingOverlay, LethalSchedule, PacmanConfig, PacmanWorld};
pub use procgen::{ProcgenConfig, ProcgenWorld, visible_actions};
pub use procgen_sys::{
    DistributionMode, Engine as ProcgenEngine, Game, InstallError, ProcgenError,
};
pub use world::{action_names, frame_shape, make_world, num_actions};

/// Why a world could not be made or stepped.
#[derive(Debug, thiserror::Error)]
pub enum EnvError {
    /// The settings cannot work; the message says which and what to do.
    #[error("{0}")]
    Config(String),
    /// Procgen's engine could not be had, or refused something.
    #[error(transparent)]
    Procgen(#[from] procgen_sys::ProcgenError),
    /// A step was asked for with an action that the world does not have.
    #[error("action {action} of copy {env} is out of range: this world has {num_actions} actions")]
    ActionOutOfRange {
        /// The copy, counted from 0.
        env: usize,
        /// The action given.
        action: u8,
        /// The world's number of actions; valid ones are below it.
        num_actions: usize,
    },
    /// A step was asked for with a buffer of the wrong length.
    #[error("{name} has {got} entries, but the world has {num_envs} copies")]
    BufferLength {
        /// Which buffer.
        name: &'static str,
        /// Its entries.
        got: usize,
        /// The world's copies.
        num_envs: usize,
    },
}
