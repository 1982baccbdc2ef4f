//! `nature`: convolutions without padding, each followed by ReLU, then a fully connected layer on the whole last map.
//! Source: Mnih et al. 2015, the paper's network.

use candle_core::{Result, Tensor};

use super::interface::{ActingTorso, Torso, TorsoKind, TorsoParameters};
use crate::compute::Kernels;
use crate::geometry::{ConvLayer, ConvShape, read_size};
use crate::init::Initializer;
use crate::kernels::buffer::Buffer;
use crate::kernels::conv::Stack;
use crate::kernels::dense::Dense;
use crate::kernels::images::Pixels;
use crate::kernels::isa::{AnySimd, Simd, with_simd};
use crate::kernels::precision::Precision;
use crate::kernels::torso::torso;
use crate::layers::LayerSpec;

pub(super) const NATURE: TorsoKind = TorsoKind {
    settings: &["conv"],
    build: |settings| Box::new(Nature::new(settings.input, settings.conv)),
    read_size,
    convolutions: "without padding, each followed by ReLU",
    fc_input: "their output as channel, row, column",
};

#[derive(Debug)]
struct Nature {
    input: (usize, usize, usize),
    /// Shapes of the layers before the first one that does not fit.
    shapes: Vec<ConvShape>,
    /// All layers, including those that do not fit.
    conv: Vec<ConvLayer>,
}

impl Nature {
    /// Builds the torso for an input of (height, width, channels).
    fn new(input: (usize, usize, usize), conv: &[ConvLayer]) -> Self {
        let mut maps = input;
        let shapes = conv.iter().map_while(|layer| {
            let shape = ConvShape::new(maps, *layer)?;
            maps = shape.output();
            Some(shape)
        });
        Self {
            input,
            shapes: shapes.collect(),
            conv: conv.to_vec(),
        }
    }
}

impl Torso for Nature {
    fn convolutions(&self) -> Vec<LayerSpec> {
        let mut channels_in = self.input.2;
        let layers = self.conv.iter().enumerate().map(|(index, layer)| {
            let weight = [layer.out, channels_in, layer.kernel, layer.kernel];
            channels_in = layer.out;
            let name = format!("torso.conv{}", index + 1);
            LayerSpec {
                locations: self.shapes.get(index).map_or(0, ConvShape::locations),
                ..LayerSpec::new(name, &weight, Initializer::Orthogonal)
            }
        });
        layers.collect()
    }

    fn f3_shape(&self) -> (usize, usize, usize) {
        self.shapes.last().map_or(self.input, ConvShape::output)
    }

    fn features(
        &self,
        kernels: Kernels,
        parameters: &TorsoParameters<Tensor>,
        frames: &Tensor,
        needs_f3: bool,
    ) -> Result<(Option<Tensor>, Tensor)> {
        let layers = parameters.convolutions.iter().zip(&self.conv);
        let layers: Vec<_> = layers
            .map(|(layer, conv)| (&layer.weight, &layer.bias, conv.stride))
            .collect();
        let (weight, bias) = (&parameters.fc.weight, &parameters.fc.bias);
        match kernels {
            Kernels::Fused(precision) if !needs_f3 => {
                Ok((None, torso(frames, &layers, weight, bias, precision)?))
            }
            _ => {
                let maps = kernels.conv_stack(frames, &layers)?;
                let f4 = kernels.linear_of_maps(&maps, weight, bias)?;
                Ok((needs_f3.then_some(maps), f4))
            }
        }
    }

    fn for_actor(
        &self,
        precision: Precision,
        parameters: TorsoParameters<Vec<f32>>,
    ) -> ActingTorso {
        let channels = self.shapes.last().map_or(1, |last| last.channels_out);
        let (layers, fc) = (parameters.concatenated(), parameters.fc);
        with_simd!(AnySimd::fastest(precision), simd => {
            let stack = Stack::new(simd, &self.shapes, &layers, false, false);
            let fc = Dense::for_maps(simd, &fc.weight, fc.bias, channels);
            Box::new(move |frames: &[u8]| f4(&stack, &fc, frames))
        })
    }
}

fn f4<S: Simd>(stack: &Stack<S>, fc: &Dense<S>, frames: &[u8]) -> Buffer<f32> {
    let count = frames.len() / stack.image_len();
    let mut maps = Buffer::<S::Element>::new(count * fc.inputs());
    stack.forward(Pixels::Bytes(frames), &mut maps);
    fc.forward(maps)
}
