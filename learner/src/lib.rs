//! The learner's library: losses, optimiser, one update, affinity, checkpoints and the parity check.
//! The arithmetic here knows no network connection, no replay and no world.

#![cfg_attr(test, allow(clippy::unwrap_used))]

pub mod affinity;
pub mod augment;
pub mod auxiliary;
pub mod batch;
pub mod batch_source;
pub mod checkpoint;
mod config;
mod error;
pub mod gradients;
mod learning;
pub mod loss;
pub mod optim;
mod outlets;
pub mod parity;
mod run;
mod shards;
pub mod target;
mod tensors;
pub mod update;

pub use affinity::{
    AffinityEstimator, Alphabet, ExactAffinity, ExactSettings, LearnedAffinity, LearnedSettings,
};
pub use augment::{Augment, AugmentSettings};
pub use auxiliary::{Objective, curl::CurlSettings, dim::Lambda};
pub use batch::{Batch, NO_ACTION};
pub use driml_model::{Compute, DeviceName, Operations};

pub use config::{AffinityConfig, AlphabetKind, Config, ConfigError, EstimatorKind, LearnerPart};
pub use error::UpdateError;
pub use learning::{Learning, Weights};
pub use optim::AdamSettings;
pub use run::{RunArgs, run};
pub use update::{Learner, LearnerSettings, NetworkParameters, UpdateReport};
