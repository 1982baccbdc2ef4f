//! The sizes of a stack of convolutions: what goes into each layer, what comes out, how many scalars its parameters have.
//! It computes no convolution.

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

/// Sizes of one convolution with a square kernel and without padding.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ConvShape {
    /// Rows of the input.
    pub height: usize,
    /// Columns of the input.
    pub width: usize,
    /// Channels of the input.
    pub channels_in: usize,
    /// Channels of the output.
    pub channels_out: usize,
    /// Side of the kernel.
    pub kernel: usize,
    /// Step between two windows, the same in both directions.
    pub stride: usize,
}

impl ConvShape {
    /// The sizes of `layer` on an input of (height, width, channels); `None` if the kernel does not fit or a size is 0.
    pub fn new(
        (height, width, channels_in): (usize, usize, usize),
        layer: ConvLayer,
    ) -> Option<Self> {
        let ConvLayer {
            out,
            kernel,
            stride,
        } = layer;
        let exists = kernel > 0 && stride > 0 && channels_in > 0 && out > 0;
        let fits = kernel <= height.min(width);
        (exists && fits).then_some(Self {
            height,
            width,
            channels_in,
            channels_out: out,
            kernel,
            stride,
        })
    }

    /// Rows of the output.
    pub fn out_height(&self) -> usize {
        (self.height - self.kernel) / self.stride + 1
    }

    /// Columns of the output.
    pub fn out_width(&self) -> usize {
        (self.width - self.kernel) / self.stride + 1
    }

    /// Height, width and channels of the output.
    pub fn output(&self) -> (usize, usize, usize) {
        (self.out_height(), self.out_width(), self.channels_out)
    }

    /// Windows in one image, which are the locations of the output map.
    pub fn locations(&self) -> usize {
        self.out_height() * self.out_width()
    }

    /// Scalars in one window.
    pub fn patch_len(&self) -> usize {
        self.kernel * self.kernel * self.channels_in
    }

    /// Scalars in one input image.
    pub fn image_len(&self) -> usize {
        self.height * self.width * self.channels_in
    }

    /// Scalars in one output map.
    pub fn map_len(&self) -> usize {
        self.locations() * self.channels_out
    }

    /// Scalars in the weight.
    pub fn weight_len(&self) -> usize {
        self.patch_len() * self.channels_out
    }

    /// Scalars in weight and bias.
    pub fn parameters_len(&self) -> usize {
        self.weight_len() + self.channels_out
    }
}
