//! The worlds in which agents act: deterministic from a seed, without a network connection or tensors.
//! Stepping policies, recording and statistics live in `driml-actor`.
//!
//! Every world is N environments behind one trait, [`Environment`]: `observe` writes the current frames,
//! `step` takes an action for each environment. An environment that ends starts again by itself.
//!
//! | name | frame | actions | what for |
//! | --- | --- | --- | --- |
//! | `procgen:GAME` | 64 x 64 x 3 | 15 | the benchmark: Procgen's own engine, loaded at run time |
//! | `mspacman` | 21 x 19 x 3 | 5 | continual learning and predictability: four ghosts, lethal by choice |
//! | `ising` | 84 x 84 x 1 | 1 | an Ising patch in noise: what can be predicted and what cannot |
//! | `chain` | settable x 1 | 3 | a corridor with a known best return, for fast learning tests |
//! | `exec:COMMAND` | as it declares | as it declares | your own world, in its own process |
//! | `libenv:PATH:GAME` | 64 x 64 x 3 | 15 | one of Procgen's games by another build of its library |
//!
//! [`WorldConfig`] holds the settings of any of these worlds (`kind` says which) and builds the world. [`WorldName`]
//! reads the names above from a command line. [`FrameStack`] stacks frames without crossing the end of an episode.
//! [`RestrictedWorld`] gives a world fewer actions and smaller frames.
//!
//! To add a world in another language, write a program that speaks the protocol of [`ExecWorld`]. To add one in Rust without a
//! change here, [`register`] it. To add one here, write a file in `worlds/` with its settings, which implement [`WorldSettings`],
//! and the world itself, which implements [`Environment`] (or, if its environments are stepped one by one, [`SingleEnv`] for one of them);
//! then give it a line in `worlds/mod.rs`, and a preset as `deploy/docs/src/how-to/own-world.md` says.
//!
//! ```
//! use driml_envs::{ChainConfig, FrameStack, StepEnd, WorldConfig};
//!
//! let config = WorldConfig::Chain(ChainConfig {
//!     cells: 8, height: 12, width: 12, step_limit: 30, reward_left: 0.1, reward_right: 1.0,
//! });
//! let num_envs = 2;
//! let mut world = config.build(num_envs, 7, 1)?;
//! let mut stack = FrameStack::new(world.frame_shape(), 4, num_envs);
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
//! Environment i of a world depends on the seed, i and its own actions only, not on how many environments there are. No numbers that
//! affect learning have defaults here: settings are written in full, and unknown keys are rejected.

#![cfg_attr(test, allow(clippy::unwrap_used, clippy::print_stdout))]

mod environment;
mod envs;
mod error;
mod frame_stack;
#[cfg(test)]
mod playing;
mod plugin;
mod registry;
mod restricted;
mod saved;
mod settings;
mod worlds;

pub use environment::{Environment, FrameShape, StepEnd, StepResult};
pub use envs::{SerialWorld, SingleEnv};
pub use error::EnvError;
pub use frame_stack::FrameStack;
pub use plugin::{CustomKind, CustomWorld, preset as custom_preset, register};
pub use procgen_sys::{DistributionMode, Engine as ProcgenEngine, Game, ProcgenError};
pub use registry::WorldName;
pub use restricted::{ActionSet, RestrictedWorld};
pub use settings::{BuildResult, Variants, WorldSettings};
pub use worlds::WorldConfig;
pub use worlds::chain::{ChainConfig, ChainWorld};
pub use worlds::exec::{ExecConfig, ExecWorld, probe_command as probe_exec_command};
pub use worlds::ising::{Boundary, IsingConfig, IsingWorld};
pub use worlds::pacman::{IsingOverlay, LethalSchedule, PacmanConfig, PacmanWorld};
pub use worlds::procgen::{ProcgenConfig, ProcgenWorld, visible_actions};
