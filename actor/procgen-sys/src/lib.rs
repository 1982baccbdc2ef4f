//! Procgen's engine from Rust: fetches the pinned `libenv.so`, loads it, and steps it behind a safe interface.
//! It does not map the engine's flags to episodes or levels, and needs no Python once the wheel is unpacked.
//!
//! The engine is the published wheel of procgen 0.10.7 (MIT licence, <https://github.com/openai/procgen>).
//! It is a C++ library that ends the whole process on a bad option, so everything is checked here first.

// The engine is a C library: calling it and owning the memory it writes to cannot be done in safe Rust. The other `unsafe` of the
// workspace is in `learner/model/src/gemm.rs`.
#![allow(unsafe_code)]
#![cfg_attr(test, allow(clippy::unwrap_used))]

mod cache;
mod check;
mod ffi;
mod game;
mod install;
mod library;
mod options;
mod pinned;
mod vec_game;
mod wheel;

pub use cache::Cache;
pub use game::{DistributionMode, Game, ParseGameError, ParseModeError};
pub use install::{Engine, InstallError};
pub use library::LoadError;
pub use options::{NUM_ENVS_MAX, NUM_THREADS_MAX, Options, OptionsError};
pub use vec_game::{FRAME_BYTES, FRAME_SIDE, NUM_ACTIONS, RESET, State, VecGame};
pub use wheel::{LIBENV_SHA256, VERSION, WHEEL_NAME, WHEEL_SHA256, download_command};

/// What every error about the engine ends with: the way to go on without it.
pub const WITHOUT_ENGINE: &str = "(`--env mspacman` is the world that needs no engine)";

/// Why the engine could not be made or driven.
#[derive(Debug, thiserror::Error)]
pub enum ProcgenError {
    /// The engine is not on this machine and could not be put there.
    #[error(transparent)]
    Install(#[from] InstallError),
    /// The engine is on this machine but cannot be loaded.
    #[error(transparent)]
    Load(#[from] LoadError),
    /// The settings would end the process inside the engine.
    #[error(transparent)]
    Options(#[from] OptionsError),
    /// An action, or their number, is not one the engine takes.
    #[error("stepping procgen: {0}")]
    Action(String),
    /// A state belongs to another game, or a copy's number is out of range.
    #[error("moving a procgen state: {0}")]
    State(String),
    /// The engine does not describe its buffers as version 0.10.7 does.
    #[error("procgen's engine is not the one this was written for: {0} {WITHOUT_ENGINE}")]
    Unexpected(String),
}
