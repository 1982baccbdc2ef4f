//! Procgen's engine from Rust: fetches the pinned `libenv.so`, loads it, and steps it behind a safe interface.
//! It does not map the engine's flags to episodes or levels, and needs no Python once the wheel is unpacked.
//!
//! The engine is the published wheel of procgen 0.10.7 (MIT licence, <https://github.com/openai/procgen>).
//! It is a C++ library that ends the whole process on a bad option, so everything is checked here first.
//!
//! Start with [`Engine::install`], which puts the engine into the cache folder once, and [`VecGame`], which steps N environments of a
//! [`Game`] as [`Options`] describe them. A step is one call of [`VecGame::act`]; its results are in the game's
//! buffers, one element or frame per environment. `driml-envs` makes a world of the game.
//!
//! ```no_run
//! use procgen_sys::{DistributionMode, Engine, FRAME_BYTES, Game, Options, VecGame};
//!
//! let engine = Engine::install(&mut |line| eprintln!("{line}"))?;
//! let options = Options {
//!     game: Game::Coinrun,
//!     num_envs: 2,
//!     num_levels: 500,
//!     start_level: 0,
//!     rand_seed: 1,
//!     num_threads: 0,
//!     distribution_mode: DistributionMode::Easy,
//!     use_sequential_levels: false,
//!     paint_vel_info: false,
//!     use_backgrounds: true,
//!     center_agent: true,
//!     restrict_themes: false,
//! };
//! let mut game = VecGame::new(&engine, &options)?;
//! for _ in 0..100 {
//!     game.act(&[7, 7])?; // To the right, in both environments.
//! }
//! assert_eq!(game.frames().len(), 2 * FRAME_BYTES);
//! println!("earned {:?} in levels {:?}", game.rewards(), game.level_seed());
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

// The engine is a C library: calling it and owning the memory it writes to cannot be done in safe Rust. The other `unsafe` of the
// workspace is in `learner/model/src/kernels/`.
#![allow(unsafe_code)]
#![cfg_attr(test, allow(clippy::unwrap_used))]

mod cache;
mod error;
mod ffi;
mod game;
mod install;
mod library;
mod nap;
mod options;
mod pinned;
mod vec_game;
mod wheel;

pub use error::ProcgenError;
pub use game::{DistributionMode, Game};
pub use install::Engine;
pub use options::{NUM_ACTIONS, NUM_ENVS_MAX, NUM_THREADS_MAX, Options};
pub use vec_game::{FRAME_BYTES, FRAME_SIDE, RESET, State, VecGame};
