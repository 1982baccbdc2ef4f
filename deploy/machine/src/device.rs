//! Which device a command computes on, and whether this program can compute there.
//! A program without CUDA goes on as `driml-cuda`.

use clap::Args;
use driml_model::DeviceName;

/// What the learner computes on.
#[derive(Clone, Copy, Debug, Args)]
pub struct DeviceFlag {
    /// What to compute on: cpu, cuda (the first GPU) or cuda:N
    #[arg(long, value_name = "DEVICE", default_value_t = DeviceName::Cpu)]
    pub device: DeviceName,
}

/// Makes sure that this program can compute on `device`: without CUDA in it, it goes on as `driml-cuda`.
///
/// # Errors
/// There is no such flavour, it cannot start here, or there is no such device.
pub fn ready_for(device: DeviceName) -> anyhow::Result<()> {
    match device {
        DeviceName::Cpu => Ok(()),
        #[cfg(not(feature = "cuda"))]
        DeviceName::Cuda(_) => Err(crate::driml_cuda::hand_over()),
        #[cfg(feature = "cuda")]
        DeviceName::Cuda(ordinal) => Ok(crate::doctor::cuda::check(ordinal)?),
    }
}
