//! The cost of a network, layer by layer: the parameter count, and the FLOPs of one state forward and backward.
//! Only matrix products count. Activations and losses take a few operations per scalar, Adam about a dozen per parameter.

use safetensors::tensor::TensorView;

use crate::config::ModelConfig;
use crate::error::Result;
use crate::weight_dtype::WeightDtype;

/// The cost of one layer. FLOPs are multiplications and additions, each counted as one.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct LayerCost {
    /// The layer's name, such as `torso.conv1`: its parameters' names without `.weight` and `.bias`.
    pub name: String,
    /// The number of scalars in the weight and the bias.
    pub parameters: u64,
    /// FLOPs of one state forward, over all locations to which the layer is applied.
    pub forward: u64,
    /// FLOPs of one state backward: the weight's gradient, and the input's gradient if an earlier layer needs it.
    pub backward: u64,
}

impl LayerCost {
    /// Whether the layer belongs to the part of the network with this name, such as `torso` or `dim.psi4`.
    pub fn is_in(&self, part: &str) -> bool {
        let rest = self.name.strip_prefix(part);
        rest.is_some_and(|rest| rest.is_empty() || rest.starts_with('.'))
    }
}

impl ModelConfig {
    /// Returns the cost of each layer of a valid configuration, in the order of [`ModelConfig::parameter_shapes`].
    pub fn layer_costs(&self) -> Vec<LayerCost> {
        let layers = self.layers().into_iter().enumerate();
        let costs = layers.map(|(index, layer)| {
            let len = |shape: &[usize]| shape.iter().product::<usize>();
            // Products with the joined input run once a state, all others once a location.
            let joined = layer.joined_width * layer.weight_shape[0];
            let products = joined + layer.locations * (len(&layer.weight_shape) - joined);
            let parameters = layer.parameters();
            let scalars = parameters.iter().map(|(_, shape)| len(shape));
            let is_in = |part: &str| layer.name.starts_with(part);
            // Bytes and one-hot actions need no gradient.
            let is_first = index == 0 || is_in("dim.action.hidden") || is_in("dim.action.skip");
            let forward = 2 * products as u64;
            LayerCost {
                forward,
                backward: if is_first { forward } else { 2 * forward },
                parameters: scalars.sum::<usize>() as u64,
                name: layer.name,
            }
        });
        costs.collect()
    }

    /// Returns the size in bytes of a safetensors file of all parameters, names and shapes included.
    pub fn weights_bytes(&self, dtype: WeightDtype) -> Result<usize> {
        let shapes = self.parameter_shapes();
        let scalars = |shape: &[usize]| shape.iter().product::<usize>() * dtype.bytes();
        let largest = shapes.iter().map(|(_, shape)| scalars(shape)).max();
        let zeros = vec![0; largest.unwrap_or(0)];
        let mut views = Vec::with_capacity(shapes.len());
        for (name, shape) in &shapes {
            let values = &zeros[..scalars(shape)];
            let view = TensorView::new(dtype.safetensors_dtype(), shape.clone(), values)?;
            views.push((name, view));
        }
        Ok(safetensors::serialize(views, None)?.len())
    }
}

/// The learner's `cost` has the test that counts each kind of layer by hand.
#[cfg(test)]
mod tests {
    use candle_core::Device;
    use rand_chacha::{ChaCha8Rng, rand_core::SeedableRng};

    use super::*;
    use crate::parameters::Parameters;
    use crate::torso::TorsoName;

    #[test]
    fn a_part_of_the_network_ends_where_a_word_of_the_name_ends() {
        let costs = ModelConfig::small().layer_costs();
        assert_eq!(costs[4].name, "dim.action.hidden");
        for (part, is_part) in [("dim", true), ("dim.action", true), ("dim.act", false)] {
            assert_eq!(costs[4].is_in(part), is_part, "{part}");
        }
    }

    /// The value stream has parameters but no products: its weight is added to the advantage stream's weight.
    #[test]
    fn a_dueling_head_has_the_products_of_a_plain_one() {
        let plain = ModelConfig::small();
        let mut dueling = plain.clone();
        dueling.head.dueling = true;
        let of_head = |config: &ModelConfig| {
            let layers = config.layer_costs().into_iter();
            let costs = layers.filter(|layer| layer.is_in("head"));
            let costs = costs.map(|layer| (layer.forward, layer.backward));
            costs.fold((0, 0), |sum, cost| (sum.0 + cost.0, sum.1 + cost.1))
        };
        assert_eq!(of_head(&plain), of_head(&dueling));
    }

    /// The residual network of the Procgen paper on 64 x 64 x 3: maps of 64 x 64, and pooled 32 x 32, 16 x 16 and 8 x 8.
    #[test]
    fn a_residual_torso_is_counted() {
        let of = |torso| ModelConfig {
            height: 64,
            width: 64,
            input_channels: 3,
            torso,
            conv: vec![],
            channels: vec![16, 32, 32],
            hidden: 512,
            ..ModelConfig::small().without_dim()
        };
        let by_hand = [(64, 3, 16), (32, 16, 32), (16, 32, 32)];
        let convolutions = by_hand.map(|(side, channels_in, out): (usize, usize, usize)| {
            let block = (side / 2).pow(2) * 9 * out * out;
            side.pow(2) * 9 * channels_in * out + 4 * block
        });
        let convolutions: usize = convolutions.iter().sum();
        for (torso, fc) in [
            (TorsoName::Impala, 2048 * 512),
            (TorsoName::Impoola, 32 * 512),
        ] {
            let costs = of(torso).layer_costs();
            let torso = costs.iter().filter(|layer| layer.is_in("torso"));
            let forward: u64 = torso.map(|layer| layer.forward).sum();
            assert_eq!(forward, 2 * (convolutions + fc) as u64);
            assert_eq!(costs[1].name, "torso.stage1.block1.conv1");
        }
        assert_eq!(convolutions, 30_081_024);
    }

    /// `driml inspect` has the test that all parameters are counted.
    #[test]
    fn a_file_of_weights_has_the_size_that_is_computed() {
        let config = ModelConfig::small();
        let rng = &mut ChaCha8Rng::seed_from_u64(1);
        let built = Parameters::init(&config, rng, &Device::Cpu).unwrap();
        for dtype in [WeightDtype::F32, WeightDtype::F16, WeightDtype::Bf16] {
            let file = built.to_safetensors_as(dtype, |_| true).unwrap();
            assert_eq!(config.weights_bytes(dtype).unwrap(), file.len());
        }
    }
}
