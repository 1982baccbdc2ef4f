//! The smallest possible networks, to pass given numbers through routines that work on all parameters at once.

use std::{collections::HashMap, iter};

use candle_core::{Device, Tensor};
use driml_model::{ConvLayer, ModelConfig, Parameters, Result};

/// Returns the config of a network with one pixel, one action and `atoms` atoms. The weight of its head has `atoms * hidden` scalars.
pub(crate) fn config(atoms: usize, hidden: usize, support: (f32, f32)) -> ModelConfig {
    ModelConfig {
        height: 1,
        width: 1,
        num_actions: 1,
        atoms,
        v_min: support.0,
        v_max: support.1,
        conv: vec![ConvLayer::new(1, 1, 1)],
        hidden,
        ..ModelConfig::small().without_dim()
    }
}

/// Returns the config of the network with the fewest parameters: eight scalars.
pub(crate) fn minimal_config() -> ModelConfig {
    config(2, 1, (-1.0, 1.0))
}

pub(crate) fn scalar_count(config: &ModelConfig) -> usize {
    let shapes = config.parameter_shapes().into_iter();
    let scalars = |(_, shape): (_, Vec<usize>)| shape.iter().product::<usize>();
    shapes.map(scalars).sum()
}

/// Fills the tensors of the parameters with these scalars, one tensor after the other. Missing scalars are 0.
pub(crate) fn tensors(config: &ModelConfig, values: &[f32]) -> Result<HashMap<String, Tensor>> {
    let mut rest = values.iter().copied().chain(iter::repeat(0.0));
    let each = config.parameter_shapes().into_iter().map(|(name, shape)| {
        let first: Vec<f32> = rest.by_ref().take(shape.iter().product()).collect();
        Ok((name, Tensor::from_vec(first, shape, &Device::Cpu)?))
    });
    each.collect()
}

/// Returns parameters with these finite scalars, in the order of [`tensors`].
pub(crate) fn parameters(config: &ModelConfig, values: &[f32]) -> Result<Parameters> {
    Parameters::from_tensors(config, |_| true, tensors(config, values)?, &Device::Cpu)
}

/// Returns the scalars of all parameters, in the order of [`parameters`].
pub(crate) fn scalars(config: &ModelConfig, parameters: &Parameters) -> Result<Vec<f32>> {
    let mut values = Vec::new();
    for (name, _) in config.parameter_shapes() {
        if let Some(var) = parameters.get(&name) {
            values.extend(var.flatten_all()?.to_vec1::<f32>()?);
        }
    }
    Ok(values)
}
