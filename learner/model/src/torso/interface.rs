//! What a torso is: its convolutions, f3 and f4 with gradients, and f4 as an actor computes it.
//! Which torsos there are is the menu's, in the folder's `mod.rs`.

use std::fmt;

use candle_core::Tensor;

use crate::compute::Kernels;
use crate::kernels::buffer::Buffer;
use crate::kernels::precision::Precision;
use crate::layers::{Layer, LayerShape};

/// A torso of given sizes, without its parameters: frames to f3, its convolutions' map, and f4, a fully connected layer on it. It ends before
/// f4's ReLU, because DIM sees f4 before it and the C51 head after it.
pub(crate) trait Torso: fmt::Debug + Send + Sync {
    /// Its convolutions, such as `torso.conv1`, in the order in which they are applied, and their initial weights drawn.
    fn convolutions(&self) -> Vec<LayerShape>;

    /// Height, width and channels of f3.
    fn local_shape(&self) -> (usize, usize, usize);

    /// Inputs of the fully connected layer.
    fn fc_inputs(&self) -> usize {
        let (height, width, channels) = self.local_shape();
        height.saturating_mul(width).saturating_mul(channels)
    }

    /// f4 [B, hidden] before its ReLU, of `frames` [B, H, W, C] u8, which are scaled by 1/255; and f3 [B, h, w, c] after its ReLU, if
    /// `local` features are wanted.
    fn features(
        &self,
        kernels: Kernels,
        parameters: &TorsoParameters<Tensor>,
        frames: &Tensor,
        local: bool,
    ) -> candle_core::Result<(Option<Tensor>, Tensor)>;

    /// The same for an actor, with products in `precision`.
    fn acting(
        &self,
        precision: Precision,
        parameters: TorsoParameters<Vec<f32>>,
    ) -> Box<dyn ActingTorso>;
}

/// A torso with its parameters, for inference.
pub(crate) trait ActingTorso: Send + Sync {
    /// f4 [n, hidden] before its ReLU, of some frames [n, H, W, C], on the calling thread.
    fn f4(&self, frames: &[u8]) -> Buffer<f32>;
}

#[derive(Clone, Debug)]
pub(crate) struct TorsoParameters<T> {
    /// In the order of [`Torso::convolutions`].
    pub(crate) convolutions: Vec<Layer<T>>,
    pub(crate) fc: Layer<T>,
}

impl<T> TorsoParameters<T> {
    /// Those of `torso`, of which `take` gives one by the name of its layer and `weight` or `bias`.
    pub(crate) fn of<E>(
        torso: &dyn Torso,
        mut take: impl FnMut(&str, &str) -> Result<T, E>,
    ) -> Result<Self, E> {
        let mut layer = |name: &str| {
            Ok(Layer {
                weight: take(name, "weight")?,
                bias: take(name, "bias")?,
            })
        };
        let convolutions = torso.convolutions().into_iter();
        Ok(Self {
            convolutions: convolutions
                .map(|it| layer(&it.name))
                .collect::<Result<_, E>>()?,
            fc: layer("torso.fc")?,
        })
    }
}

impl TorsoParameters<Vec<f32>> {
    /// Those of all convolutions, of each the weight, then the bias.
    pub(crate) fn in_line(&self) -> Vec<f32> {
        let parts = self.convolutions.iter();
        let parts = parts.flat_map(|it| [&it.weight[..], &it.bias]);
        parts.collect::<Vec<_>>().concat()
    }
}
