//! The device on which tensors live, and the kernels that compute with them.
//! The kernels themselves are in `kernels`.

use std::{fmt, str::FromStr};

use candle_core::{Device, Tensor};
use serde::{Deserialize, Serialize};

use crate::kernels::{
    candle::{self, BorderedTensors, ConvLayerTensors},
    conv, dots, grouped, impala, linear,
    precision::Precision,
};

/// The kernels of the network and the losses. All give the same results and gradients up to rounding.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kernels {
    /// This project's fused and blocked CPU kernels, with matrix products in this precision. CPU only.
    Fused(Precision),
    /// Compositions of candle's own operations, on any device. Several times slower than `Fused` on the CPU.
    Candle,
}

impl Kernels {
    /// This project's kernels in f32.
    pub const FUSED: Self = Self::Fused(Precision::F32);

    pub(crate) fn conv_stack(
        self,
        images: &Tensor,
        layers: &[ConvLayerTensors<'_>],
    ) -> candle_core::Result<Tensor> {
        match self {
            Self::Fused(precision) => conv::conv_stack(images, layers, precision),
            Self::Candle => candle::conv_stack(images, layers),
        }
    }

    /// Runs the stages of an IMPALA torso. `layers` has [`STAGE_CONVOLUTIONS`](crate::geometry::STAGE_CONVOLUTIONS) convolutions a stage.
    pub(crate) fn residual_stages(
        self,
        images: &Tensor,
        layers: &[BorderedTensors<'_>],
    ) -> candle_core::Result<Tensor> {
        match self {
            Self::Fused(precision) => impala::residual_stages(images, layers, precision),
            Self::Candle => candle::residual_stages(images, layers),
        }
    }

    pub(crate) fn linear(self, x: &Tensor, w: &Tensor, b: &Tensor) -> candle_core::Result<Tensor> {
        match self {
            Self::Fused(precision) => linear::linear(x, w, b, precision),
            Self::Candle => candle::linear(x, w, b),
        }
    }

    /// Applies the layer to maps [B, h, w, c], flattened as PyTorch's weights expect: channel, row, column.
    pub(crate) fn linear_of_maps(
        self,
        maps: &Tensor,
        w: &Tensor,
        b: &Tensor,
    ) -> candle_core::Result<Tensor> {
        match self {
            Self::Fused(precision) => linear::linear_of_maps(maps, w, b, precision),
            Self::Candle => candle::linear(&maps.permute((0, 3, 1, 2))?.flatten_from(1)?, w, b),
        }
    }

    /// Computes the outputs [B, out] of one group a row, of the layer `w` [groups * out, in] on `x` [B, in].
    pub(crate) fn grouped_linear(
        self,
        x: &Tensor,
        w: &Tensor,
        b: &Tensor,
        groups: &[u8],
        out: usize,
    ) -> candle_core::Result<Tensor> {
        match self {
            Self::Fused(precision) => grouped::grouped_linear(x, w, b, groups, out, precision),
            Self::Candle => candle::grouped_linear(x, w, b, groups, out),
        }
    }

    /// Dot products [L, B, B] of anchors and candidates, location by location, in f32. `psi` and `phi` are
    /// [B, L, R], or [B, R] for one vector that is paired with every location of the other.
    pub fn dot_products(self, psi: &Tensor, phi: &Tensor) -> candle_core::Result<Tensor> {
        match self {
            Self::Fused(_) => dots::dot_products(psi, phi),
            Self::Candle => candle::dot_products(psi, phi),
        }
    }

    pub(crate) fn relu(self, x: &Tensor) -> candle_core::Result<Tensor> {
        match self {
            Self::Fused(_) => linear::relu(x),
            Self::Candle => candle::relu(x),
        }
    }
}

/// A device and the kernels that run on it.
#[derive(Clone, Debug)]
pub struct Compute {
    /// The device of parameters, batches and losses.
    pub device: Device,
    /// The kernels that run on the device.
    pub kernels: Kernels,
}

impl Compute {
    /// The CPU with this project's kernels.
    pub const CPU: Self = Self::cpu(Precision::F32);

    /// The CPU with this project's kernels, products in `precision`.
    pub const fn cpu(precision: Precision) -> Self {
        Self {
            device: Device::Cpu,
            kernels: Kernels::Fused(precision),
        }
    }
}

/// A device by its name: `cpu`, `cuda` (the first GPU) or `cuda:N`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub enum DeviceName {
    /// The CPU.
    Cpu,
    /// The NVIDIA GPU with this number, in the driver's order.
    Cuda(usize),
}

/// The reason why a device cannot be used.
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
pub struct DeviceError(String);

impl DeviceName {
    /// Checks that a device of this kind supports `precision`, whether or not it is present.
    pub fn check_precision(self, precision: Precision) -> Result<(), DeviceError> {
        match (self, precision) {
            // Only this project's CPU kernels support another precision than f32.
            (Self::Cuda(_), Precision::Bf16) => Err(DeviceError(format!(
                "{self} computes only in f32: set learner.precision = \"f32\", or compute {precision} on the CPU"
            ))),
            _ => Ok(()),
        }
    }

    /// Opens the device with its fastest kernels and products in `precision`.
    ///
    /// # Errors
    /// The GPU is absent, the program was built without the feature `cuda`, or `precision` is bf16 on a GPU.
    pub fn open(self, precision: Precision) -> Result<Compute, DeviceError> {
        self.check_precision(precision)?;
        match self {
            Self::Cpu => Ok(Compute::cpu(precision)),
            Self::Cuda(ordinal) => {
                // All threads share one stream. `Device::new_cuda` gives each thread another stream, without ordering between them.
                let device = Device::new_cuda_with_stream(ordinal).map_err(|why| {
                    DeviceError(format!(
                        "{self} cannot be used: {why}; `driml doctor` says what is missing"
                    ))
                })?;
                Ok(Compute {
                    kernels: Kernels::Candle,
                    device,
                })
            }
        }
    }
}

impl fmt::Display for DeviceName {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Cpu => f.write_str("cpu"),
            Self::Cuda(ordinal) => write!(f, "cuda:{ordinal}"),
        }
    }
}

impl From<DeviceName> for String {
    fn from(device: DeviceName) -> Self {
        device.to_string()
    }
}

impl TryFrom<String> for DeviceName {
    type Error = DeviceError;

    fn try_from(name: String) -> Result<Self, DeviceError> {
        name.parse()
    }
}

impl FromStr for DeviceName {
    type Err = DeviceError;

    fn from_str(name: &str) -> Result<Self, DeviceError> {
        let unknown = || DeviceError(format!("{name:?} is not a device: use cpu, cuda or cuda:N"));
        match name.split_once(':') {
            None if name == "cpu" => Ok(Self::Cpu),
            None if name == "cuda" => Ok(Self::Cuda(0)),
            Some(("cuda", ordinal)) => ordinal.parse().map(Self::Cuda).map_err(|_| unknown()),
            _ => Err(unknown()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn devices_have_names() {
        for name in ["cpu", "cuda:0", "cuda:3"] {
            assert_eq!(name.parse::<DeviceName>().unwrap().to_string(), name);
        }
        assert_eq!("cuda".parse::<DeviceName>().unwrap(), DeviceName::Cuda(0));
        for wrong in ["", "gpu", "cuda:", "cuda:-1", "cpu:0", "CUDA"] {
            let error = wrong.parse::<DeviceName>().unwrap_err().to_string();
            assert!(error.contains("use cpu, cuda or cuda:N"), "{error}");
        }
    }

    #[cfg(not(feature = "cuda"))]
    #[test]
    fn a_program_without_cuda_says_so() {
        let error = DeviceName::Cuda(0).open(Precision::F32).unwrap_err();
        let error = error.to_string();
        let is_told = error.contains("cuda:0 cannot be used") && error.contains("driml doctor");
        assert!(is_told, "{error}");
    }
}
