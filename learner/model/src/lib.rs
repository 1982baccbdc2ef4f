//! The network that actor and learner share: a convolutional torso, the C51 head and the DIM heads, with CPU kernels for them.
//! This crate knows no processes, replay or environments, and computes no loss.
//!
//! The learner differentiates through [`Network`]. An actor uses [`PolicyNetwork`], which runs the same kernels without a graph.
//! The C51 head may be dueling and noisy ([`HeadConfig`]). Every variant reduces to one linear layer, so later code handles them
//! alike. The caller supplies the noise ([`HeadNoise`]); without noise, noisy layers use their means. [`Parameters`] hold the
//! weights under PyTorch's names and shapes. Start at [`ModelConfig`], which fixes every shape, and at [`Network::features`]:
//!
//! ```
//! use candle_core::{Device, Tensor};
//! use driml_model::{Kernels, ModelConfig, Network, Parameters};
//! use rand_chacha::{ChaCha8Rng, rand_core::SeedableRng};
//!
//! // Three actions, and frames of 8 x 8 x 1.
//! let config = ModelConfig::small();
//! let rng = &mut ChaCha8Rng::seed_from_u64(1);
//! let parameters = Parameters::init(&config, rng, &Device::Cpu)?;
//! let network = Network::new(&config, &parameters, Kernels::FUSED)?;
//! // Two states of 8 x 8 x 1 bytes, channels last.
//! let states = Tensor::zeros((2, 8, 8, 1), candle_core::DType::U8, &Device::Cpu)?;
//! let logits = network.logits(&network.features(&states)?.f4, None)?;
//! assert_eq!(network.q_values(&logits)?.dims(), [2, 3]);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
#![cfg_attr(test, allow(clippy::unwrap_used))]

mod compute;
mod config;
mod cost;
mod error;
mod geometry;
mod gradients;
mod heads;
mod init;
mod input;
mod kernels;
mod layers;
mod network;
mod parameters;
mod policy;
mod torso;
mod weight_dtype;

pub use compute::{Compute, DeviceError, DeviceName, Kernels};
pub use config::{DimHeads, LossLayer, ModelConfig};
pub use cost::LayerCost;
pub use error::{ModelError, Result};
pub use geometry::ConvLayer;
pub use gradients::backward;
pub use heads::c51::EXPECTED_RETURN_ERROR;
pub use heads::config::HeadConfig;
pub use heads::noise::HeadNoise;
pub use input::{FrameSize, InputSize, ReadArea, Resizer};
pub use kernels::conv::conv_stack;
pub use kernels::exponentials::{exp_minus_max, soft_clip};
pub use kernels::isa::{describe_kernels, is_bf16_fast, multiply_in_first_cache};
pub use kernels::linear::{linear, relu};
pub use kernels::precision::Precision;
pub use kernels::tensors::{Values, floats, values_of};
pub use network::{Encoder, Features, Network};
pub use parameters::{Parameters, is_dim};
pub use policy::{PolicyNetwork, argmax};
pub use torso::TorsoName;
pub use weight_dtype::WeightDtype;
