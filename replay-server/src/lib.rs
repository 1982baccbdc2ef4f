//! The replay server stores each transition exactly once, enforces the replay ratio, and serves batches. It draws each k with the batch.
//! It handles bytes and integers, never tensors, and does not interpret the content of a frame.
//!
//! Start at [`run`], which runs a whole replay server process, or at [`Replay`], its core without network, clock and threads: chunks go in,
//! batches come out. [`RateLimiter`] decides which side has to wait. [`horizon`] decides how far ahead the positive of a row lies.
//!
//! The setting `replay.sampling` draws anchors uniformly, or in proportion to a power of the C51 loss at their last update. In the second
//! case a batch holds the probability of each row, by which the learner weights the loss, and [`Replay::set_priorities`] takes the new
//! losses. Each of several shards contributes rows in proportion to the transitions that it holds.
//!
//! ```
//! use driml_protocol::{ActorJoin, Chunk, ChunkHeader, End, Horizon, InsertReply, RunSpec};
//! use driml_replay_server::{Config, Replay};
//!
//! let spec = RunSpec {
//!     horizon: Horizon::Fixed { k: 2 },
//!     ..RunSpec::smallest()
//! };
//! let config = Config {
//!     replay_ratio: 8.0,
//!     warmup_transitions: 10,
//!     ..Config::unlimited(1000)
//! };
//! let mut replay = Replay::new(&spec, &config, 4)?;
//! replay.join_actor(ActorJoin { actor: 0, incarnation: 1 })?;
//!
//! let mut chunk = Chunk::zeroed(ChunkHeader {
//!     incarnation: 1,
//!     streams: 1,
//!     steps: 20,
//!     frame_bytes: 1,
//!     ..ChunkHeader::default()
//! });
//! for row in 0..20 {
//!     chunk.frame_mut(row).fill(row as u8);
//!     chunk.set(row, 1, 0.5, End::Running);
//! }
//! let stored = replay.insert(&chunk);
//! assert!(matches!(stored, InsertReply::Stored { inserted_total: 20, .. }));
//!
//! let batch = replay.sample(4).expect("20 transitions are more than the warm-up and a batch");
//! // The frames count the steps, so s_{t+k} is two after s_t.
//! assert_eq!(batch.states_k()[0], batch.states_t()[0] + 2);
//! assert_eq!(batch.n_step_returns(), [0.5; 4]);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

#![cfg_attr(test, allow(clippy::unwrap_used))]

mod config;
mod ledger;
mod persist;
mod rate_limiter;
mod replay;
mod sampling;
mod service;
mod storage;

pub use config::{Compression, Config, RatioStart};
pub use driml_protocol::NotReady;
pub use ledger::actors::{ACTORS_MAX, STREAMS_MAX};
pub use persist::{
    KeptSize, Mark, PersistArgs, PersistError, RecoveryControl, RecoveryReport, ReplayFolder,
    kept_size,
};
pub use rate_limiter::RateLimiter;
pub use replay::Replay;
pub use sampling::{
    batch::PackedBatch,
    episodes::{RETURN_ERROR, return_sum_error},
    horizon,
    rows::{
        PriorityCounts,
        prioritised::{PRIORITY_MIN, PROBABILITY_ERROR},
    },
};
pub use service::{RunArgs, run, shared_memory_bytes};
