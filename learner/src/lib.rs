//! The learner: trains the network on batches of replayed transitions, with the C51 loss and at most one auxiliary loss.
//!
//! Start at [`Agent`], which holds the networks and the optimiser and performs one update. An agent needs no other process:
//!
//! ```
//! use driml_learner::{Agent, Batch, Compute, UpdateSettings};
//! use rand_chacha::{ChaCha8Rng, rand_core::SeedableRng};
//!
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! // The tables [model] and [learner.update] of a run's config.toml.
//! # const MODEL: &str = "height = 8\nwidth = 8\ninput_channels = 1\nnum_actions = 2\natoms = 5\nv_min = -1.0\nv_max = 1.0\n\
//! #     conv = [{ out = 4, kernel = 4, stride = 2 }]\nhidden = 8\nembedding_dim = 8\naction_embed = 2\n\
//! #     dim = { psi3 = false, phi3 = false, psi4 = true, phi4 = true, action = true }";
//! # const UPDATE: &str = "double_dqn = false\nauxiliary_loss = \"dim\"\ncondition_on_action = true\ntanh_clip = 20.0\n\
//! #     lambda = { 3t3 = 0.0, 3t4 = 0.0, 4t3 = 0.0, 4t4 = 1.0 }\nmax_grad_norm = 10.0\ntarget_period_updates = 312\n\
//! #     target_tau = 0.95\nadam = { lr = 1e-3, beta1 = 0.9, beta2 = 0.999, eps = 1e-8 }";
//! let (model, settings): (_, UpdateSettings) = (toml::from_str(MODEL)?, toml::from_str(UPDATE)?);
//! let rng = &mut ChaCha8Rng::seed_from_u64(1);
//! let mut agent = Agent::new(model, settings, &Compute::CPU, rng)?;
//! let report = agent.update(&Batch {
//!     rows: 2,
//!     states_t: &[10; 2 * 8 * 8], // s_t, u8
//!     anchors: None,              // not augmented
//!     positives: 1,
//!     states_k: &[20; 2 * 8 * 8], // s_{t+k}
//!     states_n: &[30; 2 * 8 * 8], // s_{t+n}
//!     action: &[0, 1],
//!     next_action: &[1, 1],
//!     n_step_return: &[0.5, -0.5],
//!     bootstrap_discount: &[0.9, 0.0],
//!     positive_valid: &[1, 1],
//!     importance_weight: None,
//! })?;
//! assert_eq!(report.losses.auxiliary[0].0, "dim_4t4");
//! assert!(report.losses.total.is_finite() && agent.updates() == 1);
//! # Ok(())
//! # }
//! ```
//!
//! [`Learner`] is an agent within a run. It takes the replay server's batches, enlarges and augments their states, estimates the
//! action affinity ([`affinity`]), numbers the versions of the weights and saves [`checkpoint`]s. Lockstep mode runs the same code.
//! A batch passes through the modules in this order: `learner`, `prepare`, `agent`, `losses_and_gradients`, `auxiliary::loss`, [`optimiser`].
//! [`run`] is the learner process. All communication with other processes is in [`remote`]; no other module here uses zenoh.
//!
//! To add an auxiliary loss, add a file to [`auxiliary`] and a line to its menu. The loss functions are in [`losses`], Adam and the
//! target network in [`optimiser`]. [`parity`] compares one update with PyTorch's in float64.

#![cfg_attr(test, allow(clippy::unwrap_used))]

pub mod affinity;
mod agent;
pub mod augment;
pub mod auxiliary;
mod batch;
pub mod checkpoint;
mod config;
pub mod cost;
mod deduplicate;
mod error;
pub mod importance;
pub mod insight;
mod learner;
pub mod losses;
mod losses_and_gradients;
pub mod optimiser;
pub mod parity;
mod prepare;
mod ranges;
pub mod remote;
mod run_counts;
mod settings;
mod tensors;

pub use affinity::{
    AffinityEstimator, Alphabet, ExactAffinity, ExactSettings, LearnedAffinity, LearnedSettings,
};
pub use agent::{Agent, NetworkParameters, UpdateReport};
pub use augment::{AugmentSettings, Augmenter};
pub use auxiliary::{AuxiliaryKind, positives::Positives, settings::Lambda};
pub use batch::{Batch, OwnedBatch};
pub use config::{AffinityConfig, AlphabetKind, Config, EstimatorKind, LearnerConfig};
pub use driml_model::{Compute, DeviceName, Kernels, Precision};
pub use error::{Result, UpdateError};
pub use learner::Learner;
pub use losses_and_gradients::{Losses, LossesAndGradients, UpdateNoise};
pub use optimiser::adam::AdamSettings;
pub use remote::run::{RunArgs, run};
pub use run_counts::{BatchPart, RunCounts};
pub use settings::UpdateSettings;
