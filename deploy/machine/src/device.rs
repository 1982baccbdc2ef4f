//! Which device a command computes on, and whether this program can compute there.
//! It computes nothing.

use clap::Args;
use driml_model::DeviceName;

use crate::{doctor::cuda, error::Usage};

/// What the learner computes on.
#[derive(Clone, Copy, Debug, Args)]
pub struct DeviceFlag {
    /// Device: cpu, cuda (the first GPU) or cuda:N
    #[arg(long, value_name = "DEVICE", default_value_t = DeviceName::Cpu)]
    pub device: DeviceName,
}

/// Makes sure that this program can compute on `device`.
pub fn ready_for(device: DeviceName) -> Result<(), Usage> {
    match device {
        DeviceName::Cpu => Ok(()),
        DeviceName::Cuda(ordinal) => cuda::check(ordinal),
    }
}

/// A GPU's name, compute capability and memory; none if the CPU computes.
pub fn gpu(device: DeviceName) -> Option<String> {
    match device {
        DeviceName::Cpu => None,
        DeviceName::Cuda(ordinal) => cuda::describe(ordinal).ok(),
    }
}
