//! The network that actor and learner share: a convolutional torso, the C51 head and the DIM heads, with their own CPU kernels.
//! It has never heard of processes, replay or worlds, and it computes no loss.
//!
//! The learner differentiates through [`Network`]; an actor uses [`PolicyNetwork`], which runs the same kernels without
//! a graph. [`Parameters`] hold the weights under PyTorch's names and shapes.
#![cfg_attr(test, allow(clippy::unwrap_used))]

mod c51_head;
mod compute;
mod config;
mod conv;
mod dim_head;
mod encoder;
mod error;
mod gemm;
mod geometry;
mod im2col;
mod init;
mod input;
mod linear;
mod network;
mod policy;
mod stack;
mod stock;
mod torso;
mod weights;

pub use compute::{Compute, DeviceError, DeviceName, Operations};
pub use config::{DimParts, ModelConfig};
pub use conv::{conv_stack, conv2d_relu};
pub use encoder::Encoder;
pub use error::{ModelError, Result};
pub use geometry::{ConvLayer, ConvShape};
pub use input::Enlarge;
pub use linear::{linear, linear_relu, relu};
pub use network::{Features, Network};
pub use policy::PolicyNetwork;
pub use weights::Parameters;
