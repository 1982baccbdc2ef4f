//! The DIM heads Psi and Phi: residual blocks that map features, and for Psi the action, to vectors for dot products.
//! This module computes no score and no loss.
//!
//! A block is out(relu(hidden(x))) + skip(x). Source: Mazoure et al. 2020, appendix.

use candle_core::{D, DType, Tensor};

use crate::compute::Kernels;
use crate::config::ModelConfig;
use crate::error::{ModelError, Result};
use crate::kernels::residual::{BlockParameters, residual_block};
use crate::parameters::Parameters;

/// A residual block on features, optionally with an action embedding joined to them.
#[derive(Debug)]
pub(crate) struct DimHead {
    kernels: Kernels,
    parameters: BlockParameters,
}

impl DimHead {
    pub(crate) fn new(name: &str, parameters: &Parameters, kernels: Kernels) -> Result<Self> {
        let tensor = |layer: &str, part: &str| parameters.tensor(&format!("{name}.{layer}"), part);
        let parameters = BlockParameters {
            hidden_weight: tensor("hidden", "weight")?,
            hidden_bias: tensor("hidden", "bias")?,
            out_weight: tensor("out", "weight")?,
            skip_weight: tensor("skip", "weight")?,
            out_biases: vec![tensor("out", "bias")?],
        };
        Ok(Self {
            kernels,
            parameters,
        })
    }

    /// Computes vectors [.., outputs] of `x` [.., f], or of [x; joined].
    ///
    /// A row of `joined` [B, e] serves all locations of its state. So its products become one bias vector per
    /// group of rows, and the tiled concatenation is never built.
    pub(crate) fn forward(&self, x: &Tensor, joined: Option<&Tensor>) -> Result<Tensor> {
        let Kernels::Fused(precision) = self.kernels else {
            return self.forward_by_layers(x, joined);
        };
        Ok(residual_block(x, joined, &self.parameters, precision)?)
    }

    /// Computes the same with candle's operations, layer by layer: W [x; joined] = W_x x + W_joined joined.
    fn forward_by_layers(&self, x: &Tensor, joined: Option<&Tensor>) -> Result<Tensor> {
        let kernels = self.kernels;
        let features = x.dim(D::Minus1)?;
        let bias = |weight: &Tensor, bias: &Tensor| -> Result<Tensor> {
            let Some(joined) = joined else {
                return Ok(bias.clone());
            };
            let weight = weight.narrow(1, features, weight.dim(1)? - features)?;
            Ok(kernels.linear(joined, &weight, bias)?)
        };
        let block = &self.parameters;
        let out_bias = Tensor::stack(&block.out_biases, 0)?.sum(0)?;
        let hidden_bias = bias(&block.hidden_weight, &block.hidden_bias)?;
        let skip_bias = bias(&block.skip_weight, &out_bias)?;
        let hidden_weight = block.hidden_weight.narrow(1, 0, features)?;
        let skip_weight = block.skip_weight.narrow(1, 0, features)?;
        let hidden = kernels.relu(&kernels.linear(x, &hidden_weight, &hidden_bias)?)?;
        // The skip's result serves as the bias of `out`, which saves an addition.
        let skip = kernels.linear(x, &skip_weight, &skip_bias)?;
        Ok(kernels.linear(&hidden, &block.out_weight, &skip)?)
    }
}

/// The action embedding: a one-hot vector through a residual block whose skip layer has a bias.
#[derive(Debug)]
pub(crate) struct ActionEmbedding {
    block: DimHead,
    num_actions: usize,
}

impl ActionEmbedding {
    pub(crate) fn new(
        config: &ModelConfig,
        parameters: &Parameters,
        kernels: Kernels,
    ) -> Result<Self> {
        let mut block = DimHead::new("dim.action", parameters, kernels)?;
        let skip_bias = parameters.tensor("dim.action.skip", "bias")?;
        block.parameters.out_biases.push(skip_bias);
        Ok(Self {
            block,
            num_actions: config.num_actions,
        })
    }

    /// Computes embeddings [B, e] of `actions` [B], integers below the number of actions. They are read on the CPU and best stored there.
    pub(crate) fn forward(&self, actions: &Tensor) -> Result<Tensor> {
        let (indices, count) = (actions.detach().to_dtype(DType::I64)?, self.num_actions);
        let indices = indices.to_vec1::<i64>()?;
        let mut one_hot = vec![0.0f32; indices.len() * count];
        for (row, &action) in one_hot.chunks_exact_mut(count).zip(&indices) {
            let index = usize::try_from(action).ok();
            let unknown = || ModelError::Input(format!("action {action} of {count}"));
            let entry = index.and_then(|index| row.get_mut(index));
            *entry.ok_or_else(unknown)? = 1.0;
        }
        let device = self.block.parameters.hidden_weight.device();
        let one_hot = Tensor::from_vec(one_hot, (indices.len(), count), device)?;
        self.block.forward(&one_hot, None)
    }
}
