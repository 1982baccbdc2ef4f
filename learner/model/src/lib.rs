//! The network that actor and learner share: a convolutional torso, the C51 head and the DIM heads, with their own CPU kernels.
//! It has never heard of processes, replay or worlds, and it computes no loss.
//!
//! The learner differentiates through [`Network`]; an actor uses [`PolicyNetwork`], which runs the same kernels without
//! a graph. [`Parameters`] hold the weights under PyTorch's names and shapes.
#![cfg_attr(test, allow(clippy::unwrap_used))]

mod compute;
mod config;
mod encoder;
mod error;
mod geometry;
mod heads;
mod init;
mod input;
mod kernels;
mod network;
mod parameters;
mod policy;
mod torso;

pub use compute::{Compute, DeviceError, DeviceName, Kernels};
pub use config::{DimHeads, ModelConfig};
pub use encoder::Encoder;
pub use error::{ModelError, Result};
pub use geometry::{ConvLayer, ConvShape};
pub use input::Enlarge;
pub use kernels::conv::{conv_stack, conv2d_relu};
pub use kernels::linear::{linear, linear_relu, relu};
pub use network::{Features, Network};
pub use parameters::Parameters;
pub use policy::PolicyNetwork;
