//! The shapes of a stack of convolutions: each layer's input, output and parameter count.
//! This module computes no convolution.

use serde::{Deserialize, Serialize};

/// One convolution: square kernel, no padding, then ReLU.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ConvLayer {
    /// Output channels.
    pub out: usize,
    /// Side of the square kernel in pixels.
    pub kernel: usize,
    /// Step between two windows in pixels, the same in both directions.
    pub stride: usize,
}

impl ConvLayer {
    /// Takes the arguments in the order of PyTorch's `Conv2d`, without the input channels.
    pub const fn new(out: usize, kernel: usize, stride: usize) -> Self {
        Self {
            out,
            kernel,
            stride,
        }
    }
}

/// The shape of one convolution with a square kernel and without padding. `height` and `width` are the input's.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct ConvShape {
    pub(crate) height: usize,
    pub(crate) width: usize,
    pub(crate) channels_in: usize,
    pub(crate) channels_out: usize,
    pub(crate) kernel: usize,
    /// Step between two windows, the same in both directions.
    pub(crate) stride: usize,
}

impl ConvShape {
    /// Returns the shape of `layer` on an input of (height, width, channels); `None` if the kernel does not fit or a size is 0.
    pub(crate) fn new(
        (height, width, channels_in): (usize, usize, usize),
        layer: ConvLayer,
    ) -> Option<Self> {
        let sizes = [layer.kernel, layer.stride, channels_in, layer.out];
        let fits = layer.kernel <= height.min(width);
        (!sizes.contains(&0) && fits).then_some(Self {
            height,
            width,
            channels_in,
            channels_out: layer.out,
            kernel: layer.kernel,
            stride: layer.stride,
        })
    }

    /// Returns the shape of a 3 x 3 convolution with padding 1 on an input of (height, width, channels), as one without padding
    /// on the bordered input. `height` and `width` thus include the border. The output is as large as the unbordered input.
    pub(crate) const fn bordered(
        (height, width, channels_in): (usize, usize, usize),
        channels_out: usize,
    ) -> Self {
        Self {
            height: height + 2,
            width: width + 2,
            channels_in,
            channels_out,
            kernel: 3,
            stride: 1,
        }
    }

    pub(crate) fn out_height(&self) -> usize {
        (self.height - self.kernel) / self.stride + 1
    }

    pub(crate) fn out_width(&self) -> usize {
        (self.width - self.kernel) / self.stride + 1
    }

    /// Height, width and channels of the output.
    pub(crate) fn output(&self) -> (usize, usize, usize) {
        (self.out_height(), self.out_width(), self.channels_out)
    }

    /// The number of windows in one image, which is the number of locations in the output map.
    pub(crate) fn locations(&self) -> usize {
        self.out_height() * self.out_width()
    }

    pub(crate) fn image_len(&self) -> usize {
        self.height * self.width * self.channels_in
    }

    pub(crate) fn map_len(&self) -> usize {
        self.locations() * self.channels_out
    }

    pub(crate) fn weight_len(&self) -> usize {
        self.kernel * self.kernel * self.channels_in * self.channels_out
    }

    /// The numbers of scalars in the weight and in the bias.
    pub(crate) fn parameter_lens(&self) -> [usize; 2] {
        [self.weight_len(), self.channels_out]
    }
}

/// Convolutions in one stage of an IMPALA torso: one before the pool, then two in each of two residual blocks.
pub(crate) const STAGE_CONVOLUTIONS: usize = 5;

/// Returns height, width and channels after a 3 x 3 max pool of stride 2 and padding 1, where the padding is never the largest.
pub(crate) const fn pooled_size(
    (height, width, channels): (usize, usize, usize),
) -> (usize, usize, usize) {
    (height.div_ceil(2), width.div_ceil(2), channels)
}

/// Returns the shapes of all convolutions of stages with these widths on an input of
/// (height, width, channels), in the order of application, and the shape of the output.
pub(crate) fn stage_shapes(
    input: (usize, usize, usize),
    widths: &[usize],
) -> (Vec<ConvShape>, (usize, usize, usize)) {
    let (mut shapes, mut maps) = (Vec::new(), input);
    for &width in widths {
        let first = ConvShape::bordered(maps, width);
        maps = pooled_size(first.output());
        shapes.push(first);
        shapes.extend([ConvShape::bordered(maps, width); STAGE_CONVOLUTIONS - 1]);
    }
    (shapes, maps)
}

/// Returns the rows and columns, from the upper left corner of an image of (height, width), that the windows
/// of `conv` cover. Pixels beyond change no output. `None` if a kernel does not fit.
///
/// The last layer's whole output is read. A layer with n output rows reads `stride * (n - 1) + kernel` input rows.
pub(crate) fn read_size(conv: &[ConvLayer], image: (usize, usize)) -> Option<(usize, usize)> {
    let mut size = (image.0, image.1, 1);
    for layer in conv {
        size = ConvShape::new(size, *layer)?.output();
    }
    let input_side = |outputs: usize| {
        let layers = conv.iter().rev();
        layers.fold(outputs, |n, layer| layer.stride * (n - 1) + layer.kernel)
    };
    Some((input_side(size.0), input_side(size.1)))
}
