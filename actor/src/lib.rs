//! An actor: a policy in many environments, whose transitions go to the replay server.
//! It never sees a batch and never learns; weights come from the learner.
//!
//! Start at [`run`], a whole actor process, or at [`Collector`], the same without a network connection. Below them [`Acting`]
//! steps a world with a [`Policy`], [`ChunkRecorder`] makes chunks of the steps, and [`Delivery`] brings them to the replay server.
//!
//! ```
//! use driml_actor::{ActError, Acting, Policy, ChunkRecorder};
//! use driml_envs::{EnvError, Environment, FrameShape, StepEnd};
//! use driml_protocol::BufferPool;
//! use rand_chacha::{ChaCha8Rng, rand_core::SeedableRng};
//!
//! /// Two environments that show how often they were stepped.
//! struct Counter(u8);
//!
//! impl Environment for Counter {
//!     fn frame_shape(&self) -> FrameShape {
//!         FrameShape::new(1, 1, 1)
//!     }
//!     fn num_actions(&self) -> usize {
//!         3
//!     }
//!     fn num_envs(&self) -> usize {
//!         2
//!     }
//!     fn observe(&mut self, frames: &mut [u8]) {
//!         frames.fill(self.0);
//!     }
//!     fn step(&mut self, _: &[u8], rewards: &mut [f32], ends: &mut [StepEnd]) -> Result<(), EnvError> {
//!         self.0 += 1;
//!         rewards.fill(0.5);
//!         ends.fill(StepEnd::Running);
//!         Ok(())
//!     }
//! }
//!
//! /// Takes the same action in every state.
//! struct Always(u8);
//!
//! impl Policy for Always {
//!     fn act(&mut self, _: &[u8], _: f64, _: &mut ChaCha8Rng, actions: &mut [u8]) -> Result<(), ActError> {
//!         actions.fill(self.0);
//!         Ok(())
//!     }
//! }
//!
//! let mut acting = Acting::new(Box::new(Counter(0)), 1, ChaCha8Rng::seed_from_u64(1))?;
//! // Chunks of actor 7's incarnation 1, from two environments with frames of one byte.
//! let mut recorder = ChunkRecorder::new(BufferPool::new(1), 7, 1, 2, 1);
//! recorder.begin(0, 3);
//! let chunk = loop {
//!     let step = acting.step(&mut Always(2), 0.0)?;
//!     let full = recorder.record(step.frames, step.actions, step.rewards, step.ends);
//!     if let Some(chunk) = full {
//!         break chunk;
//!     }
//! };
//! assert_eq!(chunk.frames(), [0, 1, 2, 0, 1, 2]);
//! assert_eq!(chunk.actions(), [2; 6]);
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

pub use acting::{Acting, ActingState, Step};
pub use collect::{Collector, CollectorState, Incarnation};
pub use config::{ActorSettings, Config, EpsilonLadder, SettingsError};
pub use delivery::{Delivery, DeliveryError, DeliveryLimits};
pub use error::ActError;
pub use evaluate::{Evaluation, Watch, episode_returns};
pub use policy::{NetworkPolicy, Policy, RandomPolicy};
pub use recorder::{ChunkNumbers, ChunkRecorder};
pub use run::{RunArgs, run};
pub use schedule::Schedule;
