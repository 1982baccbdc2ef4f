//! The configuration that fixes the network's shapes, and the names and shapes of its parameters.
//! It holds no training setting. No number has a default: each comes from a preset.

use serde::{Deserialize, Serialize};

use crate::error::{ModelError, Result};
use crate::geometry::{ConvLayer, ConvShape};
pub(crate) use crate::heads::config::HeadConfig;
use crate::heads::config::{ADVANTAGE, HEAD, VALUE};
use crate::init::Initializer;
use crate::layers::LayerSpec;
use crate::torso::TorsoName;
use crate::torso::interface::{Torso, TorsoSettings};

/// Largest size of any one dimension; a configuration beyond it is rejected.
const DIMENSION_MAX: usize = 1 << 16;
/// Largest number of scalars in one parameter; a configuration beyond it is rejected.
const PARAMETER_LEN_MAX: usize = 1 << 28;
/// Largest absolute return of a support. Beyond it, f32 could overflow in a sum over a batch, so the configuration is rejected.
const RETURN_MAX: f32 = 1e30;
/// Largest number of actions, because an action and the count each take one byte. A larger configuration is rejected.
const ACTIONS_MAX: usize = 255;

/// The configuration that fixes every shape of the network.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ModelConfig {
    /// Height of the network's input in pixels.
    pub height: usize,
    /// Width of the network's input in pixels.
    pub width: usize,
    /// Channels of the network's input, after frame stacking.
    pub input_channels: usize,
    /// Number of actions, 1 to 255.
    pub num_actions: usize,
    /// Atoms of each return distribution, at least 2.
    pub atoms: usize,
    /// Return at the first atom, within +-1e30. Expected returns are f32: a narrow support far from 0 holds only few distinct values.
    pub v_min: f32,
    /// Return at the last atom, within +-1e30.
    pub v_max: f32,
    /// The torso that computes f3. Settings of earlier versions lack this field and mean `nature`.
    #[serde(default)]
    pub torso: TorsoName,
    /// For `nature`: the convolutions, first to last, at least one. A ReLU follows each. The last output is f3.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub conv: Vec<ConvLayer>,
    /// For `impala` and `impoola`: the channels of each stage, first to last, at least one. The last stage's output after ReLU is f3.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub channels: Vec<usize>,
    /// For `impala` and `impoola`: whether the initial weight of each residual block's second convolution is
    /// divided by the square root of the number of blocks. Absent: no.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub scale_blocks: bool,
    /// Width of the fully connected layer f4.
    pub hidden: usize,
    /// Dimension of the vectors whose dot products are DIM scores, and width of the DIM heads' hidden layers.
    pub embedding_dim: usize,
    /// Width of the action embedding.
    pub action_embed: usize,
    /// The DIM heads that exist.
    pub dim: DimHeads,
    /// Layers that only an auxiliary loss uses, in addition to the DIM heads.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub loss_layers: Vec<LossLayer>,
    /// The structure of the C51 head. Settings of earlier versions lack this field and mean one linear layer.
    #[serde(default, skip_serializing_if = "HeadConfig::is_plain")]
    pub head: HeadConfig,
}

/// A linear layer that only an auxiliary loss uses, named `dim.NAME` among the parameters. It starts uniform, like the C51 head.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LossLayer {
    /// The layer's name: lower-case letters, digits and `_`. Names of DIM heads are taken.
    pub name: String,
    /// Width of the input.
    pub inputs: usize,
    /// Width of the output.
    pub outputs: usize,
}

impl LossLayer {
    /// Returns the common prefix of the names of this layer's parameters, without the final dot.
    pub fn prefix(&self) -> String {
        format!("dim.{}", self.name)
    }
}

/// The DIM heads that exist. A head exists only if a loss weight (lambda) needs it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DimHeads {
    /// Psi over the locations of f3(s_t).
    pub psi3: bool,
    /// Phi over the locations of f3(s_{t+k}).
    pub phi3: bool,
    /// Psi over f4(s_t).
    pub psi4: bool,
    /// Phi over f4(s_{t+k}).
    pub phi4: bool,
    /// Whether Psi sees the embedded action. Without a Psi no embedding is built.
    pub action: bool,
}

impl DimHeads {
    /// No DIM head, as in the plain C51 agent, in target networks and in actors.
    pub const NONE: Self = Self::uniform(false);
    /// Every head, and Psi sees the action.
    pub const ALL: Self = Self::uniform(true);

    const fn uniform(exists: bool) -> Self {
        Self {
            psi3: exists,
            phi3: exists,
            psi4: exists,
            phi4: exists,
            action: exists,
        }
    }

    /// Whether the action embedding exists: there is a Psi, and it sees the action.
    pub fn embeds_action(&self) -> bool {
        self.action && (self.psi3 || self.psi4)
    }
}

impl ModelConfig {
    /// Checks that a network can be built from this configuration.
    ///
    /// # Errors
    /// [`ModelError::Config`] names the field: a size of 0 or above 65,536, a kernel larger than its input, a parameter of more
    /// than 2^28 scalars, more than 255 actions, fewer than 2 atoms, a `head.noisy_sigma` out of range, `v_min` not below
    /// `v_max`, either beyond +-1e30, no convolution or stage, a setting of another torso, or an invalid loss layer name.
    pub fn validate(&self) -> Result<()> {
        let fail = |what: String| Err(ModelError::Config(what));
        let check_up_to = |max: usize, name: &str, size: usize| match (1..=max).contains(&size) {
            true => Ok(()),
            false => fail(format!("{name} is {size}, must be 1 to {max}")),
        };
        let check = |name: &str, size| check_up_to(DIMENSION_MAX, name, size);
        check("height", self.height)?;
        check("width", self.width)?;
        check("input_channels", self.input_channels)?;
        check_up_to(ACTIONS_MAX, "num_actions", self.num_actions)?;
        check("atoms", self.atoms)?;
        check("hidden", self.hidden)?;
        check("embedding_dim", self.embedding_dim)?;
        check("action_embed", self.action_embed)?;
        if self.atoms < 2 {
            return fail(format!("atoms is {}, must be at least 2", self.atoms));
        }
        let (v_min, v_max) = (self.v_min, self.v_max);
        for (name, end) in [("v_min", v_min), ("v_max", v_max)] {
            if !(-RETURN_MAX..=RETURN_MAX).contains(&end) {
                return fail(format!(
                    "{name} is {end:e}, must be within -{RETURN_MAX:e} and {RETURN_MAX:e}"
                ));
            }
        }
        if v_min >= v_max {
            return fail(format!("v_min {v_min} must be below v_max {v_max}"));
        }
        self.head.validate()?;
        self.torso.check_settings(&self.torso_settings())?;
        for (index, &width) in self.channels.iter().enumerate() {
            check(&format!("channels[{index}]"), width)?;
        }
        let mut input = (self.height, self.width, self.input_channels);
        for (index, layer) in self.conv.iter().enumerate() {
            check(&format!("conv[{index}].out"), layer.out)?;
            check(&format!("conv[{index}].kernel"), layer.kernel)?;
            check(&format!("conv[{index}].stride"), layer.stride)?;
            let Some(shape) = ConvShape::new(input, *layer) else {
                let (height, width, _) = input;
                return fail(format!(
                    "conv[{index}].kernel {} exceeds its input {height}x{width}: take a larger input.height or input.width, or fewer or \
                     smaller layers in model.conv",
                    layer.kernel
                ));
            };
            input = shape.output();
        }
        for (index, LossLayer { name, .. }) in self.loss_layers.iter().enumerate() {
            let is_word = |c| matches!(c, b'a'..=b'z' | b'0'..=b'9' | b'_');
            let others = self.loss_layers[..index].iter().map(|it| it.name.as_str());
            let mut taken = others.chain(["action", "psi3", "phi3", "psi4", "phi4"]);
            if name.is_empty() || !name.bytes().all(is_word) || taken.any(|other| other == name) {
                return fail(format!(
                    "loss_layers[{index}].name is \"{name}\", must be lower-case letters, digits and _, and no other layer's name"
                ));
            }
        }
        for (name, shape) in self.parameter_shapes() {
            let is_empty = shape.contains(&0);
            let len = shape
                .iter()
                .try_fold(1usize, |len, &size| len.checked_mul(size));
            if is_empty || len.is_none_or(|len| len > PARAMETER_LEN_MAX) {
                return fail(format!(
                    "{name} would have shape {shape:?}, must be 1 to {PARAMETER_LEN_MAX} scalars"
                ));
            }
        }
        Ok(())
    }

    /// Returns this configuration without DIM heads and loss layers, as target networks and actors use it.
    pub fn without_dim(&self) -> Self {
        Self {
            dim: DimHeads::NONE,
            loss_layers: Vec::new(),
            ..self.clone()
        }
    }

    fn torso_settings(&self) -> TorsoSettings<'_> {
        TorsoSettings {
            input: (self.height, self.width, self.input_channels),
            conv: &self.conv,
            channels: &self.channels,
            scale_blocks: self.scale_blocks,
        }
    }

    /// Builds the torso. If the configuration is invalid, the torso is unusable.
    pub(crate) fn torso(&self) -> Box<dyn Torso> {
        (self.torso.kind().build)(&self.torso_settings())
    }

    /// Returns the height, width and channels of f3. Meaningful for a valid configuration.
    pub fn f3_shape(&self) -> (usize, usize, usize) {
        self.torso().f3_shape()
    }

    /// Bytes of one input frame: height * width * channels.
    pub fn frame_len(&self) -> usize {
        self.height * self.width * self.input_channels
    }

    /// Returns the atoms z_i = v_min + i (v_max - v_min) / (atoms - 1). The last atom is exactly `v_max`.
    pub fn atoms_support(&self) -> Vec<f32> {
        let (v_min, v_max) = (f64::from(self.v_min), f64::from(self.v_max));
        let last = self.atoms - 1;
        let step = (v_max - v_min) / last as f64;
        // Far from 0, v_min + (v_max - v_min) differs from v_max even in f64.
        (0..last)
            .map(|i| (v_min + i as f64 * step) as f32)
            .chain([self.v_max])
            .collect()
    }

    /// Returns names and PyTorch shapes of all parameters: torso, head, the DIM heads that exist, loss layers, in this order.
    ///
    /// Linear weights are [out, in], convolutions [out, in, k, k], biases [out]. Initial weights are drawn in
    /// this order, so those of torso and head do not depend on which DIM heads exist.
    pub fn parameter_shapes(&self) -> Vec<(String, Vec<usize>)> {
        let layers = self.layers().into_iter();
        layers.flat_map(|layer| layer.parameters()).collect()
    }

    /// Returns names and output widths of the C51 head's layers: value and advantage if dueling, else one. All take f4.
    pub(crate) fn head_layers(&self) -> Vec<(&'static str, usize)> {
        let outputs = self.num_actions.saturating_mul(self.atoms);
        if self.head.dueling {
            vec![(VALUE, self.atoms), (ADVANTAGE, outputs)]
        } else {
            vec![(HEAD, outputs)]
        }
    }

    /// All layers in the order of [`ModelConfig::parameter_shapes`].
    pub(crate) fn layers(&self) -> Vec<LayerSpec> {
        use Initializer::{Orthogonal, Uniform};
        let torso = self.torso();
        let mut layers = torso.convolutions();
        let fc = [self.hidden, torso.fc_inputs()];
        layers.push(LayerSpec::new("torso.fc", &fc, Orthogonal));
        // The means of noisy layers are uniform too, as in Fortunato et al. 2018.
        for (name, outputs) in self.head_layers() {
            layers.push(LayerSpec {
                noisy_sigma: self.head.noisy_sigma,
                // The value stream's weight is added to the advantage stream's, which is then applied to f4.
                locations: usize::from(name != VALUE),
                ..LayerSpec::new(name, &[outputs, self.hidden], Uniform)
            });
        }
        let mut embed_width = 0;
        if self.dim.embeds_action() {
            embed_width = self.action_embed;
            let shape = [self.num_actions, 0, embed_width];
            let mut block = LayerSpec::block("dim.action", 1, shape, Orthogonal);
            block[2].has_bias = true;
            layers.extend(block);
        }
        let (height, width, channels) = torso.f3_shape();
        let (local, global) = ((height.saturating_mul(width), channels), (1, self.hidden));
        for (exists, name, (locations, features), joined, initial) in [
            (self.dim.psi3, "dim.psi3", local, embed_width, Orthogonal),
            (self.dim.phi3, "dim.phi3", local, 0, Orthogonal),
            (self.dim.psi4, "dim.psi4", global, embed_width, Uniform),
            (self.dim.phi4, "dim.phi4", global, 0, Uniform),
        ] {
            if exists {
                let shape = [features, joined, self.embedding_dim];
                layers.extend(LayerSpec::block(name, locations, shape, initial));
            }
        }
        for layer in &self.loss_layers {
            let shape = [layer.outputs, layer.inputs];
            layers.push(LayerSpec::new(layer.prefix(), &shape, Uniform));
        }
        layers
    }

    /// A small network, for tests, benches and examples: input 8 x 8 x 1, maps of 3 x 3 x 4 and 2 x 2 x 5, every DIM head.
    pub fn small() -> Self {
        Self {
            height: 8,
            width: 8,
            input_channels: 1,
            num_actions: 3,
            atoms: 6,
            v_min: -1.0,
            v_max: 1.0,
            torso: TorsoName::Nature,
            conv: vec![ConvLayer::new(4, 4, 2), ConvLayer::new(5, 2, 1)],
            channels: vec![],
            scale_blocks: false,
            hidden: 7,
            embedding_dim: 8,
            action_embed: 2,
            dim: DimHeads::ALL,
            loss_layers: vec![],
            head: HeadConfig::PLAIN,
        }
    }
}
