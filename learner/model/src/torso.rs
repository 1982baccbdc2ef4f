//! The torso: frames to f3, the last convolution's map, and f4, the fully connected layer on it.
//! It ends before f4's ReLU, because DIM sees f4 before it and the C51 head after it.

use candle_core::{CpuStorage, CustomOp1, DType, Layout, Shape, Tensor};
use rayon::prelude::*;

use crate::compute::Kernels;
use crate::config::ModelConfig;
use crate::error::{ModelError, Result};
use crate::kernels::linear::floats;
use crate::parameters::Parameters;

#[derive(Debug)]
pub(crate) struct Torso {
    kernels: Kernels,
    /// Height, width and channels of a frame.
    input: [usize; 3],
    /// Weight, bias and stride of each convolution.
    convolutions: Vec<(Tensor, Tensor, usize)>,
    fc_weight: Tensor,
    fc_bias: Tensor,
}

impl Torso {
    pub(crate) fn new(
        config: &ModelConfig,
        parameters: &Parameters,
        kernels: Kernels,
    ) -> Result<Self> {
        let convolutions = config.conv.iter().enumerate().map(|(index, layer)| {
            let name = format!("torso.conv{}", index + 1);
            Ok((
                parameters.tensor(&name, "weight")?,
                parameters.tensor(&name, "bias")?,
                layer.stride,
            ))
        });
        Ok(Self {
            kernels,
            input: [config.height, config.width, config.channels],
            convolutions: convolutions.collect::<Result<_>>()?,
            fc_weight: parameters.tensor("torso.fc", "weight")?,
            fc_bias: parameters.tensor("torso.fc", "bias")?,
        })
    }

    /// f3 [B, h, w, c] after ReLU and f4 [B, hidden] before it, of `frames` [B, H, W, C] u8, which are scaled by 1/255.
    pub(crate) fn features(&self, frames: &Tensor) -> Result<(Tensor, Tensor)> {
        if frames.dtype() != DType::U8 || frames.dims().get(1..) != Some(&self.input[..]) {
            let (dtype, shape, input) = (frames.dtype(), frames.shape(), self.input);
            return Err(ModelError::Input(format!(
                "frames {shape:?} of type {dtype:?}, wanted u8 [B, {input:?}]"
            )));
        }
        let layers: Vec<_> = self
            .convolutions
            .iter()
            .map(|(weight, bias, stride)| (weight, bias, *stride))
            .collect();
        let maps = self.kernels.conv_stack(frames, &layers)?;
        let flat = match self.kernels {
            Kernels::Fused(_) => maps.apply_op1(ChannelsFirst)?,
            Kernels::Candle => maps.permute((0, 3, 1, 2))?.flatten_from(1)?,
        };
        let f4 = self.kernels.linear(&flat, &self.fc_weight, &self.fc_bias)?;
        Ok((maps, f4))
    }
}

/// Flattens maps [B, h, w, c] to [B, c * h * w], ordered channel, row, column, as PyTorch's weights expect.
struct ChannelsFirst;

impl CustomOp1 for ChannelsFirst {
    fn name(&self) -> &'static str {
        "channels-first"
    }

    fn cpu_fwd(
        &self,
        maps: &CpuStorage,
        layout: &Layout,
    ) -> candle_core::Result<(CpuStorage, Shape)> {
        let (batch, height, width, channels) = layout.shape().dims4()?;
        let flat = transposed_images(floats(maps, layout)?, height * width, channels);
        Ok((
            CpuStorage::F32(flat),
            (batch, channels * height * width).into(),
        ))
    }

    fn bwd(
        &self,
        maps: &Tensor,
        _flat: &Tensor,
        grad: &Tensor,
    ) -> candle_core::Result<Option<Tensor>> {
        Ok(Some(
            grad.contiguous()?
                .apply_op1_no_bwd(&ChannelsLast(maps.shape().clone()))?,
        ))
    }
}

/// The inverse of [`ChannelsFirst`], to maps of the given shape.
struct ChannelsLast(Shape);

impl CustomOp1 for ChannelsLast {
    fn name(&self) -> &'static str {
        "channels-last"
    }

    fn cpu_fwd(
        &self,
        flat: &CpuStorage,
        layout: &Layout,
    ) -> candle_core::Result<(CpuStorage, Shape)> {
        let (_, height, width, channels) = self.0.dims4()?;
        let maps = transposed_images(floats(flat, layout)?, channels, height * width);
        Ok((CpuStorage::F32(maps), self.0.clone()))
    }
}

/// Transposes every image [rows, cols] of a batch.
fn transposed_images(values: &[f32], rows: usize, cols: usize) -> Vec<f32> {
    let mut result = vec![0.0; values.len()];
    let len = rows * cols;
    result
        .par_chunks_mut(len)
        .zip(values.par_chunks(len))
        .with_min_len(16)
        .for_each(|(result, values)| {
            for (row, values) in values.chunks_exact(cols).enumerate() {
                for (col, &value) in values.iter().enumerate() {
                    result[col * rows + row] = value;
                }
            }
        });
    result
}
