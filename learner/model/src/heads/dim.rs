//! The DIM heads Psi and Phi: residual blocks from features, and for Psi the action, to the space of dot products.
//! They compute no score and no loss.
//!
//! A block is out(relu(hidden(x))) + skip(x). Source: Mazoure et al. 2020, appendix.

use candle_core::{D, DType, Tensor};

use crate::compute::Kernels;
use crate::config::ModelConfig;
use crate::error::{ModelError, Result};
use crate::kernels::residual::{BlockWeights, residual_block};
use crate::parameters::Parameters;

/// A residual block on features, to which an action's embedding may be joined.
#[derive(Debug)]
pub(crate) struct Head {
    block: Block,
    features: usize,
}

/// The block's parameters; `out_bias` is the sum of the biases of `out` and, where it has one, `skip`.
#[derive(Debug)]
struct Block {
    kernels: Kernels,
    hidden_weight: Tensor,
    hidden_bias: Tensor,
    out_weight: Tensor,
    out_bias: Tensor,
    skip_weight: Tensor,
}

impl Block {
    fn new(name: &str, parameters: &Parameters, kernels: Kernels) -> Result<Self> {
        let (hidden, out, skip) = (
            format!("{name}.hidden"),
            format!("{name}.out"),
            format!("{name}.skip"),
        );
        Ok(Self {
            kernels,
            hidden_weight: parameters.tensor(&hidden, "weight")?,
            hidden_bias: parameters.tensor(&hidden, "bias")?,
            out_weight: parameters.tensor(&out, "weight")?,
            out_bias: parameters.tensor(&out, "bias")?,
            skip_weight: parameters.tensor(&skip, "weight")?,
        })
    }

    /// The block on `x` [.., f].
    fn forward(&self, x: &Tensor) -> Result<Tensor> {
        self.with_biases(x, &self.hidden_bias, &self.out_bias)
    }

    /// The block on x = [features; joined], as W x = W_features features + W_joined joined.
    ///
    /// `joined` [B, e] serves all locations of its row, so its products become biases of one group a row, and the tiled
    /// concatenation is never built.
    fn forward_joined(&self, features: &Tensor, joined: &Tensor, split: usize) -> Result<Tensor> {
        let bias = |weight: &Tensor, bias: &Tensor| -> Result<Tensor> {
            let weight = weight.narrow(1, split, weight.dim(1)? - split)?;
            Ok(self.kernels.linear(joined, &weight, bias)?)
        };
        let hidden_bias = bias(&self.hidden_weight, &self.hidden_bias)?;
        let skip_bias = bias(&self.skip_weight, &self.out_bias)?;
        self.with_biases(features, &hidden_bias, &skip_bias)
    }

    /// The block on the first columns of its weights, as many as `x` [.., f] has, with biases of any number of groups.
    fn with_biases(&self, x: &Tensor, hidden_bias: &Tensor, skip_bias: &Tensor) -> Result<Tensor> {
        let with = self.kernels;
        if let Kernels::Fused(precision) = with {
            let weights = BlockWeights {
                hidden: self.hidden_weight.clone(),
                out: self.out_weight.clone(),
                skip: self.skip_weight.clone(),
            };
            return Ok(residual_block(
                x,
                hidden_bias,
                skip_bias,
                &weights,
                precision,
            )?);
        }
        let features = x.dim(D::Minus1)?;
        let hidden_weight = self.hidden_weight.narrow(1, 0, features)?;
        let skip_weight = self.skip_weight.narrow(1, 0, features)?;
        let hidden = with.linear_relu(x, &hidden_weight, hidden_bias)?;
        // The skip's result is the bias of `out`, so nothing is added separately.
        let skip = with.linear(x, &skip_weight, skip_bias)?;
        Ok(with.linear(&hidden, &self.out_weight, &skip)?)
    }
}

impl Head {
    /// The head of this name on features of this width.
    pub(crate) fn new(
        name: &str,
        features: usize,
        parameters: &Parameters,
        kernels: Kernels,
    ) -> Result<Self> {
        Ok(Self {
            block: Block::new(name, parameters, kernels)?,
            features,
        })
    }

    /// Vectors [..., rkhs] of `features` [..., f], joined with `action` [B, e] if it is there.
    pub(crate) fn forward(&self, features: &Tensor, action: Option<&Tensor>) -> Result<Tensor> {
        match action {
            None => self.block.forward(features),
            Some(action) => self.block.forward_joined(features, action, self.features),
        }
    }
}

/// The action's embedding: one-hot through a residual block, whose skip has a bias.
#[derive(Debug)]
pub(crate) struct ActionEmbedding {
    block: Block,
    skip_bias: Tensor,
    num_actions: usize,
}

impl ActionEmbedding {
    pub(crate) fn new(
        config: &ModelConfig,
        parameters: &Parameters,
        kernels: Kernels,
    ) -> Result<Self> {
        Ok(Self {
            block: Block::new("dim.action", parameters, kernels)?,
            skip_bias: parameters.tensor("dim.action.skip", "bias")?,
            num_actions: config.num_actions,
        })
    }

    /// Embeddings [B, e] of `actions` [B], integers below the number of actions; best on the CPU, where they are looked at.
    pub(crate) fn forward(&self, actions: &Tensor) -> Result<Tensor> {
        let one_hot = self.one_hot(actions)?;
        let block = &self.block;
        let bias = (&block.out_bias + &self.skip_bias)?;
        block.with_biases(&one_hot, &block.hidden_bias, &bias)
    }

    fn one_hot(&self, actions: &Tensor) -> Result<Tensor> {
        let indices = actions.detach().to_dtype(DType::I64)?.to_vec1::<i64>()?;
        let mut one_hot = vec![0.0f32; indices.len() * self.num_actions];
        for (row, &action) in one_hot.chunks_exact_mut(self.num_actions).zip(&indices) {
            let entry = usize::try_from(action)
                .ok()
                .and_then(|action| row.get_mut(action));
            *entry.ok_or_else(|| {
                ModelError::Input(format!("action {action} of {}", self.num_actions))
            })? = 1.0;
        }
        Ok(Tensor::from_vec(
            one_hot,
            (indices.len(), self.num_actions),
            self.block.hidden_weight.device(),
        )?)
    }
}
