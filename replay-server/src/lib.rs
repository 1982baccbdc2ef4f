//! The replay server: keeps transitions exactly once, holds the replay ratio, and serves batches with k drawn as they are made.
//! It knows bytes and integers, never tensors, and it does not know what a frame shows.

#![cfg_attr(test, allow(clippy::unwrap_used))]

pub mod config;
pub mod rate_limiter;
pub mod replay;

mod ledger;
mod sampling;
mod service;
mod storage;

pub use config::{Compression, Config, ConfigError, Study};
pub use ledger::actors::{ACTORS_MAX, STREAMS_MAX};
pub use replay::{Replay, Unready};
pub use sampling::{horizon, packed_batch::Draft};
pub use service::{RunArgs, run};
pub use storage::frame_store::{PackedChunk, Packer};
