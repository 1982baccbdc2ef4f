//! The DIM heads Psi and Phi: residual blocks from features, and for Psi the action, to the space of dot products.
//! They compute no score and no loss.
//!
//! A block is out(relu(hidden(x))) + skip(x). Source: Mazoure et al. 2020, appendix.

use candle_core::{DType, Tensor};

use crate::compute::Kernels;
use crate::config::ModelConfig;
use crate::error::{ModelError, Result};
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

    /// The block without a joined input. The skip's result is the bias of `out`, so nothing is added separately.
    fn forward(&self, x: &Tensor) -> Result<Tensor> {
        let with = self.kernels;
        let hidden = with.linear_relu(x, &self.hidden_weight, &self.hidden_bias)?;
        let skip = with.linear(x, &self.skip_weight, &self.out_bias)?;
        Ok(with.linear(&hidden, &self.out_weight, &skip)?)
    }

    /// The block on x = [features; joined], as W x = W_features features + W_joined joined.
    ///
    /// `joined` [B, e] serves all locations of its row, so its products become biases of one group a row, and the tiled
    /// concatenation is never built.
    fn forward_joined(&self, features: &Tensor, joined: &Tensor, split: usize) -> Result<Tensor> {
        let with = self.kernels;
        let parts = |weight: &Tensor| -> Result<(Tensor, Tensor)> {
            let joined_len = weight.dim(1)? - split;
            Ok((
                weight.narrow(1, 0, split)?,
                weight.narrow(1, split, joined_len)?,
            ))
        };
        let (hidden_features, hidden_joined) = parts(&self.hidden_weight)?;
        let (skip_features, skip_joined) = parts(&self.skip_weight)?;
        let hidden_bias = with.linear(joined, &hidden_joined, &self.hidden_bias)?;
        let hidden = with.linear_relu(features, &hidden_features, &hidden_bias)?;
        let skip_bias = with.linear(joined, &skip_joined, &self.out_bias)?;
        let skip = with.linear(features, &skip_features, &skip_bias)?;
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
        let with = block.kernels;
        let hidden = with.linear_relu(&one_hot, &block.hidden_weight, &block.hidden_bias)?;
        let bias = (&block.out_bias + &self.skip_bias)?;
        let skip = with.linear(&one_hot, &block.skip_weight, &bias)?;
        Ok(with.linear(&hidden, &block.out_weight, &skip)?)
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
