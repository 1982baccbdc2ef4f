//! The whole network with gradients, as the learner uses it.
//! It owns no weights (it shares the storage of `Parameters`) and computes no loss.

use std::collections::BTreeMap;

use candle_core::{DType, Tensor};

use crate::compute::Kernels;
use crate::config::ModelConfig;
use crate::error::{ModelError, Result};
use crate::heads::c51::q_values;
use crate::heads::dim::{ActionEmbedding, DimHead};
use crate::heads::noise::HeadNoise;
use crate::heads::streams::{HeadLayer, merge};
use crate::layers::Layer;
use crate::parameters::Parameters;
use crate::torso::interface::{Torso, TorsoParameters};

/// The torso's output for a batch of frames.
#[derive(Clone, Debug)]
pub struct Features {
    /// The last convolution's output after ReLU, [B, h, w, c], channels last. `Some` if the network has a head that reads f3.
    pub f3: Option<Tensor>,
    /// The fully connected layer's output before its ReLU, [B, hidden].
    pub f4: Tensor,
}

impl Features {
    /// Returns f3, or [`ModelError::NoHead`] if no head reads it.
    pub fn require_f3(&self) -> Result<&Tensor> {
        self.f3.as_ref().ok_or(ModelError::NoHead("psi3 or phi3"))
    }

    /// Returns the features of the rows `first` to `first + rows - 1`.
    pub fn narrow(&self, first: usize, rows: usize) -> candle_core::Result<Self> {
        let narrowed = |f3: &Tensor| f3.narrow(0, first, rows);
        Ok(Self {
            f3: self.f3.as_ref().map(narrowed).transpose()?,
            f4: self.f4.narrow(0, first, rows)?,
        })
    }

    /// Returns the features of the listed rows. A row may occur repeatedly; the gradients of its copies are summed in list order.
    pub fn select(&self, rows: &[u32]) -> candle_core::Result<Self> {
        let rows = Tensor::new(rows, self.f4.device())?;
        let selected = |features: &Tensor| features.index_select(&rows, 0);
        Ok(Self {
            f3: self.f3.as_ref().map(selected).transpose()?,
            f4: selected(&self.f4)?,
        })
    }
}

/// A torso and its parameters: from frames to f3 and f4.
#[derive(Debug)]
struct FeatureLayers {
    kernels: Kernels,
    /// Height, width and channels of a frame.
    input: [usize; 3],
    torso: Box<dyn Torso>,
    parameters: TorsoParameters<Tensor>,
}

impl FeatureLayers {
    fn new(config: &ModelConfig, parameters: &Parameters, kernels: Kernels) -> Result<Self> {
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
    fn features(&self, frames: &Tensor, needs_f3: bool) -> Result<(Option<Tensor>, Tensor)> {
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

/// The torso, the C51 head and the DIM heads that the configuration enables.
///
/// A network shares the storage of the [`Parameters`] it was built from: setting a `Var` there changes the network. Methods return
/// an error if a tensor has another shape than documented, or if the network lacks the Psi or Phi ([`ModelError::NoHead`]).
#[derive(Debug)]
pub struct Network {
    kernels: Kernels,
    torso: FeatureLayers,
    /// The layers of the C51 head.
    head: Vec<HeadLayer<Tensor>>,
    actions: usize,
    support: Vec<f32>,
    action: Option<ActionEmbedding>,
    psi3: Option<DimHead>,
    phi3: Option<DimHead>,
    psi4: Option<DimHead>,
    phi4: Option<DimHead>,
    /// Weight and bias of each loss layer, by name.
    loss_layers: BTreeMap<String, (Tensor, Tensor)>,
}

impl Network {
    /// Builds the network of `config` on `parameters`. `parameters` may hold more than `config` needs, for
    /// example the online network's parameters with a target network's configuration.
    pub fn new(config: &ModelConfig, parameters: &Parameters, kernels: Kernels) -> Result<Self> {
        config.validate()?;
        let head = |exists: bool, name: &str| {
            let head = exists.then(|| DimHead::new(name, parameters, kernels));
            head.transpose()
        };
        let embeds_action = config.dim.embeds_action();
        let action = embeds_action.then(|| ActionEmbedding::new(config, parameters, kernels));
        let loss_layers = config.loss_layers.iter().map(|layer| {
            let tensor = |part| parameters.tensor(&layer.prefix(), part);
            Ok((layer.name.clone(), (tensor("weight")?, tensor("bias")?)))
        });
        Ok(Self {
            kernels,
            loss_layers: loss_layers.collect::<Result<_>>()?,
            torso: FeatureLayers::new(config, parameters, kernels)?,
            head: HeadLayer::collect(config, |layer, part| parameters.tensor(layer, part))?,
            actions: config.num_actions,
            support: config.atoms_support(),
            action: action.transpose()?,
            psi3: head(config.dim.psi3, "dim.psi3")?,
            phi3: head(config.dim.phi3, "dim.phi3")?,
            psi4: head(config.dim.psi4, "dim.psi4")?,
            phi4: head(config.dim.phi4, "dim.phi4")?,
        })
    }

    /// The kernels that this network computes with.
    pub const fn kernels(&self) -> Kernels {
        self.kernels
    }

    /// Computes f4, and f3 if a head reads it, of `frames` [B, H, W, C] u8. Frames are scaled by 1/255.
    pub fn features(&self, frames: &Tensor) -> Result<Features> {
        let needs_f3 = self.psi3.is_some() || self.phi3.is_some();
        let (f3, f4) = self.torso.features(frames, needs_f3)?;
        Ok(Features { f3, f4 })
    }

    /// Computes the logits [B, A, atoms] of `f4` [B, hidden], which is before its ReLU as in [`Features`].
    /// `noise` perturbs the head's noisy layers; without noise they use their means.
    pub fn logits(&self, f4: &Tensor, noise: Option<&HeadNoise>) -> Result<Tensor> {
        let active = self.kernels.relu(f4)?;
        let Layer { weight, bias } = merge(&self.head, self.support.len(), noise)?;
        let logits = self.kernels.linear(&active, &weight, &bias)?;
        Ok(logits.reshape(((), self.actions, self.support.len()))?)
    }

    /// Computes the rows [B, atoms] of [`Network::logits`] for the taken actions [B], each below the number of actions.
    pub fn taken_logits(
        &self,
        f4: &Tensor,
        actions: &[u8],
        noise: Option<&HeadNoise>,
    ) -> Result<Tensor> {
        let active = self.kernels.relu(f4)?;
        let (kernels, atoms) = (self.kernels, self.support.len());
        let Layer { weight, bias } = merge(&self.head, atoms, noise)?;
        Ok(kernels.grouped_linear(&active, &weight, &bias, actions, atoms)?)
    }

    /// Computes the expected returns [B, A] of `logits` [B, A, atoms], without a gradient. On the CPU their error beyond
    /// f32 rounding is at most [`EXPECTED_RETURN_ERROR`](crate::EXPECTED_RETURN_ERROR) times the support's width.
    pub fn q_values(&self, logits: &Tensor) -> Result<Tensor> {
        Ok(q_values(self.kernels, logits, &self.support)?)
    }

    /// Computes Psi_3 [B, h * w, embedding_dim] of `f3` [B, h, w, c] and `actions` [B] (integers, ignored if Psi does not see the action).
    pub fn psi3(&self, f3: &Tensor, actions: &Tensor) -> Result<Tensor> {
        let head = require_head(self.psi3.as_ref(), "psi3")?;
        let maps = head.forward(f3, self.embed_actions(actions)?.as_ref())?;
        Ok(maps.flatten(1, 2)?)
    }

    /// Computes Phi_3 [B, h * w, embedding_dim] of `f3` [B, h, w, c].
    pub fn phi3(&self, f3: &Tensor) -> Result<Tensor> {
        let maps = require_head(self.phi3.as_ref(), "phi3")?.forward(f3, None)?;
        Ok(maps.flatten(1, 2)?)
    }

    /// Computes Psi_4 [B, embedding_dim] of `f4` [B, hidden] and `actions` [B] (integers, ignored if Psi does not see the action).
    pub fn psi4(&self, f4: &Tensor, actions: &Tensor) -> Result<Tensor> {
        let head = require_head(self.psi4.as_ref(), "psi4")?;
        head.forward(f4, self.embed_actions(actions)?.as_ref())
    }

    /// Computes Phi_4 [B, embedding_dim] of `f4` [B, hidden].
    pub fn phi4(&self, f4: &Tensor) -> Result<Tensor> {
        require_head(self.phi4.as_ref(), "phi4")?.forward(f4, None)
    }

    /// Computes W x + b [.., outputs] of `x` [.., inputs] with the loss layer of this name.
    pub fn loss_layer(&self, name: &str, x: &Tensor) -> Result<Tensor> {
        let layer = self.loss_layers.get(name);
        let (weight, bias) = layer.ok_or_else(|| {
            ModelError::Input(format!("the network has no loss layer named {name}"))
        })?;
        Ok(self.kernels.linear(x, weight, bias)?)
    }

    fn embed_actions(&self, actions: &Tensor) -> Result<Option<Tensor>> {
        let action = self.action.as_ref();
        action.map(|it| it.forward(actions)).transpose()
    }
}

fn require_head<'a>(head: Option<&'a DimHead>, name: &'static str) -> Result<&'a DimHead> {
    head.ok_or(ModelError::NoHead(name))
}

/// The torso and Psi_4 alone, which encode a state as psi_4(f4) to compare with another network's, such as CURL's keys.
///
/// An encoder shares the storage of the [`Parameters`] it was built from: setting a `Var` there changes the encoder.
#[derive(Debug)]
pub struct Encoder {
    torso: FeatureLayers,
    psi4: DimHead,
}

impl Encoder {
    /// Whether the parameter of this name belongs to the encoder.
    pub fn has_parameter(name: &str) -> bool {
        name.starts_with("torso.") || name.starts_with("dim.psi4.")
    }

    /// Builds the encoder of a network of `config` on `parameters`, which may hold more than the encoder needs.
    pub fn new(config: &ModelConfig, parameters: &Parameters, kernels: Kernels) -> Result<Self> {
        config.validate()?;
        Ok(Self {
            torso: FeatureLayers::new(config, parameters, kernels)?,
            psi4: DimHead::new("dim.psi4", parameters, kernels)?,
        })
    }

    /// Computes psi_4(f4) [B, embedding_dim] of `frames` [B, H, W, C] u8, detached from any graph.
    pub fn encode(&self, frames: &Tensor) -> Result<Tensor> {
        let (_, f4) = self.torso.features(frames, false)?;
        Ok(self.psi4.forward(&f4.detach(), None)?.detach())
    }
}
