//! The torso: frames to f3, the last convolution's map, and f4, the fully connected layer on it.
//! It ends before f4's ReLU, because DIM sees f4 before it and the C51 head after it.

use candle_core::{DType, Tensor};

use crate::compute::Kernels;
use crate::config::ModelConfig;
use crate::error::{ModelError, Result};
use crate::kernels::torso::torso;
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

    /// f4 [B, hidden] before its ReLU, of `frames` [B, H, W, C] u8, which are scaled by 1/255; and f3 [B, h, w, c] after its ReLU, if
    /// `local` features are wanted.
    pub(crate) fn features(
        &self,
        frames: &Tensor,
        local: bool,
    ) -> Result<(Option<Tensor>, Tensor)> {
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
        let (weight, bias) = (&self.fc_weight, &self.fc_bias);
        match self.kernels {
            Kernels::Fused(precision) if !local => {
                Ok((None, torso(frames, &layers, weight, bias, precision)?))
            }
            with => {
                let maps = with.conv_stack(frames, &layers)?;
                let f4 = with.linear_of_maps(&maps, weight, bias)?;
                Ok((local.then_some(maps), f4))
            }
        }
    }
}
