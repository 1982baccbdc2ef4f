//! `impala`: stages of a convolution, a max pool and two residual blocks, then a fully connected layer on the whole last map.
//! Source: Espeholt et al. 2018, the residual network of the Procgen paper (Cobbe et al. 2020).
//! `impoola`: the same, with the fully connected layer on the map's mean over locations. Source: Trumpp et al. 2025 (arXiv 2503.05546).

use candle_core::{Result, Tensor};

use super::interface::{ActingTorso, Torso, TorsoKind, TorsoParameters, TorsoSettings};
use crate::compute::Kernels;
use crate::geometry::{ConvShape, STAGE_CONVOLUTIONS, stage_shapes};
use crate::init::Initializer;
use crate::kernels::buffer::Buffer;
use crate::kernels::dense::Dense;
use crate::kernels::impala::Stages;
use crate::kernels::isa::{AnySimd, Simd, with_simd};
use crate::kernels::linear::add_rows;
use crate::kernels::precision::Precision;
use crate::kernels::rounding::store;
use crate::layers::LayerSpec;

const NAMES: [&str; STAGE_CONVOLUTIONS] = [
    "conv",
    "block1.conv1",
    "block1.conv2",
    "block2.conv1",
    "block2.conv2",
];

pub(super) const IMPALA: TorsoKind = TorsoKind {
    settings: &["channels", "scale_blocks"],
    build: |settings| Box::new(Impala::new(settings, false)),
    read_size: |_, image| Some(image),
    convolutions: "with zero padding 1: a stage is conv, max pool 3x3 of stride 2 and padding 1, and \
                   x + conv2(ReLU(conv1(ReLU(x)))) for block1 and block2",
    fc_input: "ReLU of the last stage's output as channel, row, column",
};

pub(super) const IMPOOLA: TorsoKind = TorsoKind {
    build: |settings| Box::new(Impala::new(settings, true)),
    fc_input: "the mean over the locations of ReLU of the last stage's output",
    ..IMPALA
};

/// The torso `impala` or `impoola`, on an input of (height, width, channels).
#[derive(Debug)]
struct Impala {
    input: (usize, usize, usize),
    widths: Vec<usize>,
    /// Whether the initial weight of each block's second convolution is divided by the square root of the number of blocks.
    scale_blocks: bool,
    /// Whether the fully connected layer takes the mean of f3 over its locations, as in `impoola`.
    takes_mean: bool,
}

impl Impala {
    fn new(settings: &TorsoSettings<'_>, takes_mean: bool) -> Self {
        Self {
            input: settings.input,
            widths: settings.channels.to_vec(),
            scale_blocks: settings.scale_blocks,
            takes_mean,
        }
    }
}

impl Torso for Impala {
    fn convolutions(&self) -> Vec<LayerSpec> {
        let (shapes, _) = stage_shapes(self.input, &self.widths);
        let blocks = 2 * self.widths.len();
        let smaller = 1.0 / (blocks as f32).sqrt();
        let convolution = |(index, shape): (usize, &ConvShape)| {
            let name = NAMES[index % STAGE_CONVOLUTIONS];
            let is_scaled = self.scale_blocks && name.ends_with(".conv2");
            let name = format!("torso.stage{}.{name}", index / STAGE_CONVOLUTIONS + 1);
            let (out, inputs, side) = (shape.channels_out, shape.channels_in, shape.kernel);
            LayerSpec {
                initial_scale: if is_scaled { smaller } else { 1.0 },
                locations: shape.locations(),
                ..LayerSpec::new(name, &[out, inputs, side, side], Initializer::Orthogonal)
            }
        };
        shapes.iter().enumerate().map(convolution).collect()
    }

    fn f3_shape(&self) -> (usize, usize, usize) {
        stage_shapes(self.input, &self.widths).1
    }

    fn fc_inputs(&self) -> usize {
        let (height, width, channels) = self.f3_shape();
        if self.takes_mean {
            return channels;
        }
        height.saturating_mul(width).saturating_mul(channels)
    }

    fn features(
        &self,
        kernels: Kernels,
        parameters: &TorsoParameters<Tensor>,
        frames: &Tensor,
        needs_f3: bool,
    ) -> Result<(Option<Tensor>, Tensor)> {
        let layers = parameters.convolutions.iter();
        let layers: Vec<_> = layers.map(|it| (&it.weight, &it.bias)).collect();
        let f3 = kernels.residual_stages(frames, &layers)?;
        let (weight, bias) = (&parameters.fc.weight, &parameters.fc.bias);
        let f4 = if self.takes_mean {
            kernels.linear(&f3.mean((1, 2))?, weight, bias)?
        } else {
            kernels.linear_of_maps(&f3, weight, bias)?
        };
        Ok((needs_f3.then_some(f3), f4))
    }

    fn for_actor(
        &self,
        precision: Precision,
        parameters: TorsoParameters<Vec<f32>>,
    ) -> ActingTorso {
        let (layers, fc) = (parameters.concatenated(), parameters.fc);
        let (shapes, (_, _, channels)) = stage_shapes(self.input, &self.widths);
        let takes_mean = self.takes_mean;
        with_simd!(AnySimd::fastest(precision), simd => {
            let stages = Stages::new(simd, &shapes, &layers, false);
            let fc = Dense::for_maps(simd, &fc.weight, fc.bias, channels);
            Box::new(move |frames: &[u8]| f4(simd, &stages, takes_mean, &fc, frames))
        })
    }
}

fn f4<S: Simd>(
    simd: S,
    stages: &Stages<S>,
    takes_mean: bool,
    fc: &Dense<S>,
    frames: &[u8],
) -> Buffer<f32> {
    let images = frames.chunks_exact(stages.image_len());
    let inputs = fc.inputs();
    let mut rows = Buffer::new(images.len() * inputs);
    let (mut tape, mut f3) = (stages.allocate_tape(1), Buffer::new(stages.output_len()));
    for (image, row) in images.zip(rows.chunks_exact_mut(inputs)) {
        stages.forward(image, &mut tape, &mut f3);
        if takes_mean {
            store(simd, &mean_of_locations(&f3, inputs), row);
        } else {
            store(simd, &f3, row);
        }
    }
    fc.forward(rows)
}

/// Computes the mean of `map` [locations, channels] over its locations.
fn mean_of_locations(map: &[f32], channels: usize) -> Vec<f32> {
    let mut sums = vec![0.0; channels];
    add_rows(&mut sums, map);
    let locations = (map.len() / channels) as f32;
    sums.iter().map(|sum| sum / locations).collect()
}
