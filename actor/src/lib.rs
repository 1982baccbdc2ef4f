//! An actor steps many environments with a policy and sends the transitions to the replay server.
//! It never sees a batch and never learns; its weights come from the learner.
//!
//! Start at [`run`], a whole actor process, or at [`Collector`], an actor without a network connection. [`ActingLoop`] steps a world
//! with a [`Policy`], [`ChunkRecorder`] packs the steps into chunks, and [`Delivery`] sends the chunks to the replay server.
//!
//! ```
//! use driml_actor::{ActError, ActingLoop, ChunkRecorder, RandomPolicy};
//! use driml_envs::{ChainConfig, WorldConfig};
//! use driml_protocol::BufferPool;
//! use rand_chacha::{ChaCha8Rng, rand_core::SeedableRng};
//!
//! let chain = WorldConfig::Chain(ChainConfig {
//!     cells: 8, height: 1, width: 8, step_limit: 30, reward_left: 0.1, reward_right: 1.0,
//! });
//! let mut acting = ActingLoop::new(chain.build(2, 7, 0)?, 1, ChaCha8Rng::seed_from_u64(1));
//! // Chunks of actor 7's incarnation 1, from two environments with frames of eight bytes.
//! let mut recorder = ChunkRecorder::new(BufferPool::new(1), 7, 1, 2, 8);
//! recorder.begin_chunk(0, 3);
//! let chunk = loop {
//!     let step = acting.step(&mut RandomPolicy::new(3), 0.0)?;
//!     let full = recorder.record(step.frames, step.actions, step.rewards, step.ends);
//!     if let Some(chunk) = full {
//!         break chunk;
//!     }
//! };
//! assert_eq!(chunk.frames()[..8], [0, 255, 0, 0, 0, 0, 0, 0]); // An agent begins beside the near end.
//! assert_eq!(chunk.actions().len(), 6);
//! # Ok::<(), ActError>(())
//! ```

#![cfg_attr(test, allow(clippy::unwrap_used))]

mod acting;
mod collect;
mod config;
mod delivery;
mod error;
mod evaluate;
mod policy;
mod recorder;
mod run;
mod schedule;
mod weights;

pub use acting::{ActingLoop, ActingState, Step};
pub use collect::{Collector, CollectorState, Incarnation};
pub use config::{ActorSettings, Config, EpsilonLadder};
pub use delivery::{Delivery, DeliveryLimits};
pub use error::ActError;
pub use evaluate::{Evaluation, OnStep, episode_returns};
pub use policy::{NetworkPolicy, Policy, RandomPolicy};
pub use recorder::ChunkRecorder;
pub use run::{RunArgs, run};
pub use schedule::Schedule;
