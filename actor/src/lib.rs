//! An actor: a policy in many copies of a world, whose transitions go to the replay server.
//! It never sees a batch and never learns; weights come from the learner.

#![cfg_attr(test, allow(clippy::unwrap_used))]

pub mod acting;
mod collect;
mod config;
pub mod delivery;
pub mod evaluate;
pub mod policy;
pub mod recorder;
mod run;
pub mod schedule;
pub mod weights;

pub use collect::{Collector, Incarnation};
pub use config::{ActorSettings, Config, ConfigError, EpsilonLadder, InputSize};
pub use run::{RunArgs, run};
