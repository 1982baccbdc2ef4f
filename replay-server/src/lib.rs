//! The replay server: keeps transitions exactly once, holds the replay ratio, and serves batches with k drawn as they are made.
//! It knows bytes and integers, never tensors, and it does not know what a frame shows.

#![cfg_attr(test, allow(clippy::unwrap_used))]

pub mod config;
pub mod horizon;
pub mod rate_limiter;
pub mod replay;

mod actors;
mod anchors;
mod assemble;
mod episodes;
mod frames;
mod requests;
mod ring;
mod service;
mod statistics;

pub use actors::{ACTORS_MAX, STREAMS_MAX};
pub use config::{Config, ConfigError, Study};
pub use frames::{Compression, Draft, PackedChunk, Packer};
pub use replay::{Replay, Unready};
pub use service::{RunArgs, run};
