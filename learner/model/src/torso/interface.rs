//! The interface of a torso: what the menu knows of it; its convolutions, f3 and f4 with gradients, and f4 for an actor.
//! The list of torsos is in the folder's `mod.rs`.

use std::fmt;

use candle_core::Tensor;

use crate::compute::Kernels;
use crate::error::Result;
use crate::geometry::ConvLayer;
use crate::kernels::buffer::Buffer;
use crate::kernels::precision::Precision;
use crate::layers::{Layer, LayerSpec};

/// The settings of all torsos. Each torso reads its own.
pub(crate) struct TorsoSettings<'a> {
    /// Height, width and channels of the input.
    pub(crate) input: (usize, usize, usize),
    pub(crate) conv: &'a [ConvLayer],
    pub(crate) channels: &'a [usize],
    pub(crate) scale_blocks: bool,
}

/// (height, width)
type Size = (usize, usize);

/// What the menu knows of a torso.
pub(crate) struct TorsoKind {
    /// The names of the settings that it reads. It is made of the first, which must be given.
    pub(crate) settings: &'static [&'static str],
    pub(crate) build: fn(&TorsoSettings<'_>) -> Box<dyn Torso>,
    /// Returns the size of the part of `image` that it reads, from the upper left corner; `None` if `conv` does not fit. With
    /// zero padding, every pixel is in a window.
    pub(crate) read_size: fn(conv: &[ConvLayer], image: Size) -> Option<Size>,
    /// How the convolutions are applied, and what the fully connected layer takes: see [`super::TorsoName::describe`].
    pub(crate) convolutions: &'static str,
    pub(crate) fc_input: &'static str,
}

/// A torso of given sizes, without its parameters. It turns frames into f3, the output of its convolutions, and f4, a fully
/// connected layer on f3. It ends before f4's ReLU, because DIM reads f4 before the ReLU and the C51 head after it.
pub(crate) trait Torso: fmt::Debug + Send + Sync {
    /// The convolutions, such as `torso.conv1`, in the order in which they are applied and their initial weights drawn.
    fn convolutions(&self) -> Vec<LayerSpec>;

    /// Returns the height, width and channels of f3.
    fn f3_shape(&self) -> (usize, usize, usize);

    /// The number of inputs to the fully connected layer.
    fn fc_inputs(&self) -> usize {
        let (height, width, channels) = self.f3_shape();
        height.saturating_mul(width).saturating_mul(channels)
    }

    /// Computes f4 [B, hidden] before its ReLU, of `frames` [B, H, W, C] u8 scaled by 1/255. Computes f3
    /// [B, h, w, c] after its ReLU too, if `needs_f3`.
    fn features(
        &self,
        kernels: Kernels,
        parameters: &TorsoParameters<Tensor>,
        frames: &Tensor,
        needs_f3: bool,
    ) -> candle_core::Result<(Option<Tensor>, Tensor)>;

    /// Builds the torso for an actor, with products in `precision`.
    fn for_actor(&self, precision: Precision, parameters: TorsoParameters<Vec<f32>>)
    -> ActingTorso;
}

/// A torso with its parameters, for inference: computes f4 [n, hidden] before its ReLU, of frames [n, H, W, C], on the calling thread.
pub(crate) type ActingTorso = Box<dyn Fn(&[u8]) -> Buffer<f32> + Send + Sync>;

#[derive(Clone, Debug)]
pub(crate) struct TorsoParameters<T> {
    /// Parameters of the convolutions, in the order of [`Torso::convolutions`].
    pub(crate) convolutions: Vec<Layer<T>>,
    pub(crate) fc: Layer<T>,
}

impl<T> TorsoParameters<T> {
    /// Collects the parameters of `torso`. `take` returns one, by the layer's name and `weight` or `bias`.
    pub(crate) fn collect(
        torso: &dyn Torso,
        mut take: impl FnMut(&str, &str) -> Result<T>,
    ) -> Result<Self> {
        let mut layer = |name: &str| {
            Ok(Layer {
                weight: take(name, "weight")?,
                bias: take(name, "bias")?,
            })
        };
        let convolutions = torso.convolutions().into_iter();
        let convolutions = convolutions.map(|it| layer(&it.name));
        Ok(Self {
            convolutions: convolutions.collect::<Result<_>>()?,
            fc: layer("torso.fc")?,
        })
    }
}

impl TorsoParameters<Vec<f32>> {
    /// Concatenates the convolutions' parameters: of each the weight, then the bias.
    pub(crate) fn concatenated(&self) -> Vec<f32> {
        let parts = self.convolutions.iter();
        let parts = parts.flat_map(|it| [&it.weight[..], &it.bias]);
        parts.collect::<Vec<_>>().concat()
    }
}
