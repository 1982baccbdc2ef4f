//! What this machine offers and lacks: cores, memory, devices, and the CUDA flavour of the program.
//! It starts no run and knows no setting.

#![cfg_attr(test, allow(clippy::unwrap_used))]

pub mod device;
pub mod doctor;
#[cfg(not(feature = "cuda"))]
pub mod driml_cuda;
pub mod error;
pub mod resources;
pub mod units;
