//! `impoola`: `impala` whose fully connected layer takes the mean of the last stage's map over its locations.
//! Source: Trumpp et al. 2025 (arXiv 2503.05546).

use candle_core::{Result, Tensor};

use super::impala::Impala;
use super::interface::{ActingTorso, Torso, TorsoConvolution, TorsoParameters};
use crate::compute::Kernels;
use crate::kernels::precision::Precision;

#[derive(Debug)]
pub(crate) struct Impoola(pub(crate) Impala);

impl Torso for Impoola {
    fn convolutions(&self) -> Vec<TorsoConvolution> {
        self.0.convolutions()
    }

    fn local_shape(&self) -> (usize, usize, usize) {
        self.0.local_shape()
    }

    fn fc_inputs(&self) -> usize {
        self.local_shape().2
    }

    fn features(
        &self,
        kernels: Kernels,
        parameters: &TorsoParameters<Tensor>,
        frames: &Tensor,
        local: bool,
    ) -> Result<(Option<Tensor>, Tensor)> {
        let f3 = self.0.f3(kernels, parameters, frames)?;
        let mean = f3.mean((1, 2))?;
        let f4 = kernels.linear(&mean, &parameters.fc.weight, &parameters.fc.bias)?;
        Ok((local.then_some(f3), f4))
    }

    fn acting(
        &self,
        precision: Precision,
        parameters: TorsoParameters<Vec<f32>>,
    ) -> Box<dyn ActingTorso> {
        self.0.acting_on(precision, parameters, true)
    }
}
