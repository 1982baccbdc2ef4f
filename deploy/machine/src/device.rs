//! The device that a command computes on, and whether this program can compute there: on a GPU only if built with the feature
//! `cuda`. This module computes nothing.

use clap::Args;
use driml_model::DeviceName;

use crate::{
    error::{Usage, usage},
    units,
};

#[cfg(not(feature = "cuda"))]
const BUILD_HINT: &str = "this program was built without CUDA; with a CUDA toolkit `cargo build --release --features cuda` builds one \
     that has it, without a toolkit `deploy/cuda/build.sh`";

/// What the learner computes on.
#[derive(Clone, Copy, Debug, Args)]
pub struct DeviceFlag {
    /// Device: cpu, cuda (the first GPU) or cuda:N
    #[arg(long, value_name = "DEVICE", default_value_t = DeviceName::Cpu)]
    pub device: DeviceName,
}

/// Checks that the device exists and that this program was built for it. Otherwise the error says what to do. Returns a GPU's name, compute
/// capability and memory.
pub fn check_device(device: DeviceName) -> Result<Option<String>, Usage> {
    let DeviceName::Cuda(ordinal) = device else {
        return Ok(None);
    };
    let described = gpu_count().and_then(|count| match ordinal < count {
        true => describe_gpu(ordinal),
        false => Err(format!(
            "the driver finds {}, numbered from cuda:0",
            units::count(count, "device")
        )),
    });
    let described = described.map_err(|why| usage!("cuda:{ordinal} cannot be used: {why}"))?;
    Ok(Some(described))
}

/// The number of GPUs that the driver finds, at least one, or why there is none.
#[cfg(not(feature = "cuda"))]
pub(crate) fn gpu_count() -> Result<usize, String> {
    Err(BUILD_HINT.to_owned())
}

#[cfg(feature = "cuda")]
pub(crate) fn gpu_count() -> Result<usize, String> {
    use candle_core::cuda_backend::cudarc::driver::CudaContext;

    match CudaContext::device_count() {
        Ok(0) => Err("the driver finds no device; does CUDA_VISIBLE_DEVICES hide them?".to_owned()),
        Ok(count) => Ok(count as usize),
        Err(why) => Err(format!("asking the driver: {why}")),
    }
}

/// Describes a GPU: its name, compute capability and memory. An error if the query fails or the program was not built for it.
#[cfg(not(feature = "cuda"))]
pub(crate) fn describe_gpu(_ordinal: usize) -> Result<String, String> {
    Err(BUILD_HINT.to_owned())
}

#[cfg(feature = "cuda")]
pub(crate) fn describe_gpu(ordinal: usize) -> Result<String, String> {
    use candle_core::cuda_backend::cudarc::driver::{CudaContext, DriverError};

    let query = || -> Result<_, DriverError> {
        let context = CudaContext::new(ordinal)?;
        let (free, total) = context.mem_get_info()?;
        let capability: (i32, i32) = context.compute_capability()?;
        Ok((context.name()?, capability, free, total))
    };
    let (name, (major, minor), free, total) =
        query().map_err(|why| format!("asking for its properties: {why}"))?;
    let [free, total] = [free, total].map(|bytes| units::gib(bytes as u64));
    let text = format!("{name}, compute capability {major}.{minor}, {total}, {free} free");
    match option_env!("CUDA_COMPUTE_CAP").and_then(|it| it.parse().ok()) {
        Some(built) if !runs_on(built, (major, minor)) => Err(format!(
            "{text}; this program is for {built}: build it again with CUDA_COMPUTE_CAP={major}{minor}"
        )),
        _ => Ok(text),
    }
}

/// Whether kernels compiled for the capability `built`, such as 90 for 9.0, run on a device of capability `major.minor`.
///
/// Source: nvcc's rules. From 9.0 on, candle's kernels use instructions of one architecture, which no other architecture has.
/// Kernels for older capabilities run on newer devices too, as the driver compiles them again.
#[cfg(any(test, feature = "cuda"))]
fn runs_on(built: i32, (major, minor): (i32, i32)) -> bool {
    let device = 10 * major + minor;
    device == built || built < 90 && device > built
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn kernels_run_where_nvcc_s_rules_say() {
        for (built, device, runs) in [
            (90, (9, 0), true),
            (90, (8, 9), false),
            (90, (10, 0), false),
            (80, (8, 0), true),
            (80, (8, 6), true),
            (80, (9, 0), true),
            (80, (7, 5), false),
        ] {
            assert_eq!(runs_on(built, device), runs, "{built} on {device:?}");
        }
    }

    #[cfg(not(feature = "cuda"))]
    #[test]
    fn a_program_without_cuda_says_how_to_build_one_that_has_it() {
        let said = check_device(DeviceName::Cuda(0)).unwrap_err().to_string();
        assert!(said.starts_with("cuda:0 cannot be used: this program"));
        assert!(said.contains("--features cuda"), "{said}");
        assert!(gpu_count().is_err());
    }
}
