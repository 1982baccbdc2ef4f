//! Procgen's engine from Rust: fetches the pinned `libenv.so`, loads it, and steps it behind a safe interface.
//! It does not map the engine's flags to episodes or levels, and needs no Python once the wheel is unpacked.
//!
//! The engine is the published wheel of procgen 0.10.7 (MIT licence, <https://github.com/openai/procgen>).
//! It is a C++ library that ends the whole process on a bad option, so everything is checked here first.

// The engine is a C library: calling it and owning the memory it writes to cannot be done in safe Rust. The other `unsafe` of the
// workspace is in `learner/model/src/kernels/gemm.rs`.
#![allow(unsafe_code)]
#![cfg_attr(test, allow(clippy::unwrap_used))]

mod cache;
mod check;
mod error;
mod ffi;
mod game;
mod install;
mod library;
mod options;
mod pinned;
mod release;
mod vec_game;
mod wheel;

pub use cache::Cache;
pub use error::{InstallError, LoadError, ProcgenError, WITHOUT_ENGINE};
pub use game::{DistributionMode, Game, ParseGameError, ParseModeError};
pub use install::Engine;
pub use options::{NUM_ACTIONS, NUM_ENVS_MAX, NUM_THREADS_MAX, Options, OptionsError};
pub use release::{LIBENV_SHA256, VERSION, WHEEL_NAME, WHEEL_SHA256, download_command};
pub use vec_game::{FRAME_BYTES, FRAME_SIDE, RESET, State, VecGame};
