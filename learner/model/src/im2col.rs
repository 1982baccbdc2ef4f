//! Convolution with bias and ReLU over a few images, forward and backward, by im2col and matrix products.
//! It knows neither tensors nor threads: callers split the batch.
//!
//! Images and maps are channels-last, so each row of a window is one run of kernel * channels_in values, and im2col is a
//! series of plain copies. A patch is a window laid out as [kernel row, kernel column, channel in].

use crate::gemm::{Matrix, Output, Threads, multiply};
use crate::geometry::ConvShape;
use crate::linear::{relu_gradient, relu_of};

/// Scalars of patches held at a time; more images share a tile while they fit. 384 KiB: a part of the second-level cache.
const TILE_LEN: usize = 96 * 1024;

impl ConvShape {
    fn tile_images(&self) -> usize {
        (TILE_LEN / (self.locations() * self.patch_len())).max(1)
    }

    /// Weight [out, in, k, k] as [k, k, in, out]: the matrix that patches are multiplied by.
    pub(crate) fn pack_weight(&self, weight: &[f32]) -> Vec<f32> {
        let mut packed = vec![0.0; weight.len()];
        self.for_each_weight(|plain, pack| packed[pack] = weight[plain]);
        packed
    }

    /// The inverse of `pack_weight`.
    pub(crate) fn unpack_weight(&self, packed: &[f32]) -> Vec<f32> {
        let mut weight = vec![0.0; packed.len()];
        self.for_each_weight(|plain, pack| weight[plain] = packed[pack]);
        weight
    }

    /// Calls `visit` with the index in [out, in, k, k] and the index in [k, k, in, out] of every weight.
    fn for_each_weight(&self, mut visit: impl FnMut(usize, usize)) {
        let taps = self.kernel * self.kernel;
        for tap in 0..taps {
            for channel_in in 0..self.channels_in {
                for channel_out in 0..self.channels_out {
                    visit(
                        (channel_out * self.channels_in + channel_in) * taps + tap,
                        (tap * self.channels_in + channel_in) * self.channels_out + channel_out,
                    );
                }
            }
        }
    }
}

/// Images [n, height, width, channels_in].
#[derive(Clone, Copy)]
pub(crate) enum Images<'a> {
    /// Scaled by 1/255 when read.
    Bytes(&'a [u8]),
    Floats(&'a [f32]),
}

impl<'a> Images<'a> {
    pub(crate) fn len(&self) -> usize {
        match self {
            Self::Bytes(bytes) => bytes.len(),
            Self::Floats(floats) => floats.len(),
        }
    }

    /// The scalars `range` of all images.
    pub(crate) fn slice(&self, range: std::ops::Range<usize>) -> Self {
        match self {
            Self::Bytes(bytes) => Self::Bytes(&bytes[range]),
            Self::Floats(floats) => Self::Floats(&floats[range]),
        }
    }

    /// The images as floats, scaled; `scratch` holds them if they had to be converted.
    fn floats<'b>(&self, scratch: &'b mut Vec<f32>) -> &'b [f32]
    where
        'a: 'b,
    {
        match self {
            Self::Floats(floats) => floats,
            Self::Bytes(bytes) => {
                let scaled = grown(scratch, bytes.len());
                for (scaled, &byte) in scaled.iter_mut().zip(*bytes) {
                    *scaled = f32::from(byte) * (1.0 / 255.0);
                }
                scaled
            }
        }
    }
}

/// Buffers that a thread keeps between calls.
#[derive(Default)]
pub(crate) struct ConvScratch {
    images: Vec<f32>,
    patches: Vec<f32>,
    grad_maps: Vec<f32>,
    grad_patches: Vec<f32>,
}

/// Gradients that `backward` adds to.
pub(crate) struct ConvGradients<'a> {
    /// [k, k, in, out]
    pub(crate) packed: &'a mut [f32],
    /// [out]
    pub(crate) bias: &'a mut [f32],
    /// [n, height, width, in], or None if the images need none.
    pub(crate) images: Option<&'a mut [f32]>,
}

/// maps = relu(conv(images, weight) + bias): `packed` [k, k, in, out], `bias` [out], `maps` [n, out_h, out_w, out].
pub(crate) fn forward(
    shape: &ConvShape,
    images: Images<'_>,
    packed: &[f32],
    bias: &[f32],
    maps: &mut [f32],
    scratch: &mut ConvScratch,
) {
    let weight = Matrix::new(packed, shape.patch_len(), shape.channels_out);
    let tile = shape.tile_images();
    for (index, maps) in maps.chunks_mut(tile * shape.map_len()).enumerate() {
        let count = maps.len() / shape.map_len();
        let first = index * tile * shape.image_len();
        let images = images
            .slice(first..first + count * shape.image_len())
            .floats(&mut scratch.images);
        let patches = grown(
            &mut scratch.patches,
            count * shape.locations() * shape.patch_len(),
        );
        im2col(shape, images, patches);
        let patches = Matrix::new(patches, count * shape.locations(), shape.patch_len());
        multiply(maps, Output::Replace, patches, weight, Threads::Caller);
        for location in maps.chunks_exact_mut(shape.channels_out) {
            for (value, bias) in location.iter_mut().zip(bias) {
                *value = relu_of(*value + bias);
            }
        }
    }
}

/// Adds the gradients of `forward` for `grad_maps`, whose entries count only where `maps` is above 0, as in PyTorch.
pub(crate) fn backward(
    shape: &ConvShape,
    images: Images<'_>,
    packed: &[f32],
    maps: &[f32],
    grad_maps: &[f32],
    mut grads: ConvGradients<'_>,
    scratch: &mut ConvScratch,
) {
    let weight = Matrix::new(packed, shape.patch_len(), shape.channels_out);
    let tile_len = shape.tile_images() * shape.map_len();
    let mut first = 0;
    for (maps, grad_maps) in maps.chunks(tile_len).zip(grad_maps.chunks(tile_len)) {
        let count = maps.len() / shape.map_len();
        let (rows, range) = (
            count * shape.locations(),
            first..first + count * shape.image_len(),
        );
        first = range.end;

        let masked = grown(&mut scratch.grad_maps, maps.len());
        for ((masked, &value), &grad) in masked.iter_mut().zip(maps).zip(grad_maps) {
            *masked = relu_gradient(value, grad);
        }
        for location in masked.chunks_exact(shape.channels_out) {
            for (sum, grad) in grads.bias.iter_mut().zip(location) {
                *sum += grad;
            }
        }
        let grad = Matrix::new(masked, rows, shape.channels_out);

        let patches = grown(&mut scratch.patches, rows * shape.patch_len());
        im2col(
            shape,
            images.slice(range.clone()).floats(&mut scratch.images),
            patches,
        );
        let patches = Matrix::new(patches, rows, shape.patch_len());
        multiply(
            grads.packed,
            Output::Add,
            patches.transposed(),
            grad,
            Threads::Caller,
        );

        if let Some(grad_images) = &mut grads.images {
            let grad_patches = grown(&mut scratch.grad_patches, rows * shape.patch_len());
            multiply(
                grad_patches,
                Output::Replace,
                grad,
                weight.transposed(),
                Threads::Caller,
            );
            col2im(shape, grad_patches, &mut grad_images[range]);
        }
    }
}

/// The first `len` scalars of a buffer that only grows; their content is left over from earlier use.
pub(crate) fn grown(buffer: &mut Vec<f32>, len: usize) -> &mut [f32] {
    if buffer.len() < len {
        buffer.resize(len, 0.0);
    }
    &mut buffer[..len]
}

/// Lays out every window of `images` as one row of `patches` [n * locations, patch_len].
fn im2col(shape: &ConvShape, images: &[f32], patches: &mut [f32]) {
    let run = shape.kernel * shape.channels_in;
    let mut runs = patches.chunks_exact_mut(run);
    for_each_run(shape, images.len(), |start| {
        if let Some(patch) = runs.next() {
            patch.copy_from_slice(&images[start..start + run]);
        }
    });
}

/// Adds every row of `patches` back to the window it came from.
fn col2im(shape: &ConvShape, patches: &[f32], images: &mut [f32]) {
    let run = shape.kernel * shape.channels_in;
    let mut runs = patches.chunks_exact(run);
    for_each_run(shape, images.len(), |start| {
        if let Some(patch) = runs.next() {
            for (pixel, grad) in images[start..start + run].iter_mut().zip(patch) {
                *pixel += grad;
            }
        }
    });
}

/// Calls `visit` with the first index of each window's each row, in the order of the patches.
#[inline]
fn for_each_run(shape: &ConvShape, images_len: usize, mut visit: impl FnMut(usize)) {
    let line = shape.width * shape.channels_in;
    for image in (0..images_len).step_by(shape.image_len()) {
        for out_y in 0..shape.out_height() {
            let top = image + out_y * shape.stride * line;
            for out_x in 0..shape.out_width() {
                let corner = top + out_x * shape.stride * shape.channels_in;
                for kernel_y in 0..shape.kernel {
                    visit(corner + kernel_y * line);
                }
            }
        }
    }
}
