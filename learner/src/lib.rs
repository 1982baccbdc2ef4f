//! The learner's library: losses, optimiser, one update, affinity, checkpoints and the parity check.
//! The arithmetic here knows no network connection, no replay and no world.

#![cfg_attr(test, allow(clippy::unwrap_used))]

pub mod affinity;
mod agent;
pub mod augment;
pub mod auxiliary;
pub mod batch;
pub mod checkpoint;
mod config;
mod error;
mod learner;
pub mod losses;
pub mod optimiser;
pub mod parity;
pub mod remote;
mod settings;
mod tensors;

pub use affinity::{
    AffinityEstimator, Alphabet, ExactAffinity, ExactSettings, LearnedAffinity, LearnedSettings,
};
pub use augment::{Augment, AugmentSettings};
pub use auxiliary::{Objective, positives::Positives, settings::Lambda};
pub use batch::{Batch, NO_ACTION};
pub use driml_model::{Compute, DeviceName, Operations};

pub use agent::{Agent, Evaluation, NetworkParameters, UpdateReport};
pub use config::{AffinityConfig, AlphabetKind, Config, ConfigError, EstimatorKind, LearnerPart};
pub use error::UpdateError;
pub use learner::{Learner, Weights};
pub use optimiser::adam::AdamSettings;
pub use remote::run::{RunArgs, run};
pub use settings::LearnerSettings;
