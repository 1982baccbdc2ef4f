//! From frames to f3 and f4 with gradients: a torso and its parameters.
//! The torsos themselves are in `torso`.

use candle_core::{DType, Tensor};

use crate::compute::Kernels;
use crate::config::ModelConfig;
use crate::error::{ModelError, Result};
use crate::parameters::Parameters;
use crate::torso::interface::{Torso, TorsoParameters};

#[derive(Debug)]
pub(crate) struct FeatureLayers {
    kernels: Kernels,
    /// Height, width and channels of a frame.
    input: [usize; 3],
    torso: Box<dyn Torso>,
    parameters: TorsoParameters<Tensor>,
}

impl FeatureLayers {
    pub(crate) fn new(
        config: &ModelConfig,
        parameters: &Parameters,
        kernels: Kernels,
    ) -> Result<Self> {
        let torso = config.torso();
        let parameters =
            TorsoParameters::collect(&*torso, |layer, part| parameters.tensor(layer, part))?;
        Ok(Self {
            kernels,
            input: [config.height, config.width, config.input_channels],
            torso,
            parameters,
        })
    }

    /// Computes f4 [B, hidden] before its ReLU, of `frames` [B, H, W, C] u8 scaled by 1/255. Computes f3
    /// [B, h, w, c] after its ReLU too, if `needs_f3`.
    pub(crate) fn features(
        &self,
        frames: &Tensor,
        needs_f3: bool,
    ) -> Result<(Option<Tensor>, Tensor)> {
        if frames.dtype() != DType::U8 || frames.dims().get(1..) != Some(&self.input[..]) {
            let (dtype, shape, input) = (frames.dtype(), frames.shape(), self.input);
            return Err(ModelError::Input(format!(
                "frames {shape:?} of type {dtype:?}, wanted u8 [B, {input:?}]"
            )));
        }
        let torso = &self.torso;
        Ok(torso.features(self.kernels, &self.parameters, frames, needs_f3)?)
    }
}
