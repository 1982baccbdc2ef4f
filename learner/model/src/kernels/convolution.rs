//! Convolution with bias and ReLU over a few images, forward and backward, as matrix products of windows that are read in place.
//! This module knows neither tensors nor threads: callers split the batch.
//!
//! Images and maps are channels-last. So each row of a window is one run of kernel * channels_in scalars, and
//! neighbouring windows lie stride * channels_in scalars apart. Windows are thus a tile's rows, and no window
//! is copied. The gradient of an image is added directly to the windows it came from.

use crate::geometry::ConvShape;
use crate::kernels::buffer::Buffer;
use crate::kernels::images::Images;
use crate::kernels::isa::{Element, LeftOperand, Mode, Simd, each_block, row_tiles, vectorized};
use crate::kernels::linear::{relu_gradient, relu_scalar};
use crate::kernels::panels::{Matrix, Panels, Threads};
use crate::kernels::rounding::write_rows;

impl ConvShape {
    /// Scalars in a row of an image.
    fn line_len(&self) -> usize {
        self.width * self.channels_in
    }

    /// Scalars in a row of a window.
    fn run_len(&self) -> usize {
        self.kernel * self.channels_in
    }

    /// Scalars from a window to its neighbour on the right.
    pub(crate) fn window_stride(&self) -> usize {
        self.stride * self.channels_in
    }

    /// Reorders the weight [out, in, k, k] to [k, k, in, out], the matrix that multiplies windows.
    fn pack_weight(&self, weight: &[f32]) -> Vec<f32> {
        let (taps, inputs) = (self.kernel * self.kernel, self.channels_in);
        let mut packed = vec![0.0; weight.len()];
        for (row, packed) in packed.chunks_exact_mut(self.channels_out).enumerate() {
            let at = row % inputs * taps + row / inputs;
            let outs = weight[at..].iter().step_by(inputs * taps);
            for (packed, &value) in packed.iter_mut().zip(outs) {
                *packed = value;
            }
        }
        packed
    }

    /// The inverse of `pack_weight`; writes into `weight`.
    pub(crate) fn unpack_weight(&self, packed: &[f32], weight: &mut [f32]) {
        let (taps, inputs) = (self.kernel * self.kernel, self.channels_in);
        for (out, weight) in weight.chunks_exact_mut(inputs * taps).enumerate() {
            for (channel_in, weight) in weight.chunks_exact_mut(taps).enumerate() {
                let at = channel_in * self.channels_out + out;
                let values = packed[at..].iter().step_by(inputs * self.channels_out);
                for (weight, &value) in weight.iter_mut().zip(values) {
                    *weight = value;
                }
            }
        }
    }
}

/// One convolution, its parameters packed for the kernels.
pub(crate) struct Convolution<E: Element> {
    pub(crate) shape: ConvShape,
    /// Right operand of window x weight. Every row of the kernel begins with a new step.
    forward: Panels<E>,
    /// Right operands of gradient x weight, one for each row of the kernel. Empty if the images need no gradient.
    backward: Vec<Panels<E>>,
    /// The bias repeated for every location of a row: [out_width, out].
    pub(crate) bias: Vec<f32>,
}

impl<E: Element> Convolution<E> {
    /// `weight` [out, in, k, k], `bias` [out]; `backward` says whether images will need a gradient.
    pub(crate) fn new<S: Simd<Element = E>>(
        simd: S,
        shape: ConvShape,
        weight: &[f32],
        bias: &[f32],
        backward: bool,
    ) -> Self {
        let (run, out) = (shape.run_len(), shape.channels_out);
        let packed = shape.pack_weight(weight);
        let mut forward = Panels::new(simd, shape.kernel * run.div_ceil(E::DEPTH), out);
        let matrix = Matrix::new(&packed, shape.kernel * run, out);
        forward.fill(simd, matrix, run, Threads::Caller);
        let rows = packed.chunks_exact(run * out).filter(|_| backward);
        let backward = rows.map(|row| {
            let matrix = Matrix::new(row, run, out).transposed();
            Panels::pack(simd, matrix, Threads::Caller)
        });
        Self {
            shape,
            forward,
            backward: backward.collect(),
            bias: bias.repeat(shape.out_width()),
        }
    }
}

/// Computes relu(conv(images, weight) + bias) into `maps` [n, out_height, out_width, out].
pub(crate) fn forward<S: Simd, M: Element>(
    simd: S,
    layer: &Convolution<S::Element>,
    images: Images<'_, S::Element>,
    maps: &mut [M],
) {
    let shape = &layer.shape;
    let (out_width, out) = (shape.out_width(), shape.channels_out);
    let (mut scratch, mut row) = (None, Buffer::new(out_width * out));
    // If a run is odd, the last step of the last window reads one scalar beyond the image and multiplies it by 0.
    let len = (shape.image_len(), shape.run_len() % S::Element::DEPTH);
    for (index, maps) in maps.chunks_exact_mut(shape.map_len()).enumerate() {
        let image = images.image(simd, index, len, &mut scratch);
        let mut lines = maps.chunks_exact_mut(out_width * out);
        multiply_windows(simd, layer, image, &mut row, |_, row| {
            if let Some(maps) = lines.next() {
                store_relu_row(simd, row, &layer.bias, images.scale(), maps);
            }
        });
    }
}

/// Multiplies the windows of one image by the weight, row by row. `then` receives the index of each row of the map
/// and its sums [out_width, out], stored in `row`. If a run is odd, the image needs one more scalar in bf16.
#[inline(always)]
pub(crate) fn multiply_windows<S: Simd>(
    simd: S,
    layer: &Convolution<S::Element>,
    image: &[S::Element],
    row: &mut [f32],
    mut then: impl FnMut(usize, &mut [f32]),
) {
    let shape = &layer.shape;
    for y in 0..shape.out_height() {
        for (x, windows) in row_tiles::<S>(shape.out_width(), layer.forward.vecs()) {
            let left = LeftOperand {
                values: image,
                start: y * shape.stride * shape.line_len() + x * shape.window_stride(),
                row_stride: shape.window_stride(),
                step_stride: S::Element::DEPTH,
                steps: shape.run_len().div_ceil(S::Element::DEPTH),
                run_stride: shape.line_len(),
                runs: shape.kernel,
            };
            let out = shape.channels_out;
            let to = &mut row[x * out..];
            let panels = &layer.forward;
            panels.multiply(simd, windows, left, Mode::Replace, to, out);
        }
        then(y, row);
    }
}

vectorized! {
    /// Computes relu(scale * row + bias) in place, and stores it in `maps`, rounded.
    pub(crate) fn store_relu_row<S, M>(
        simd,
        row: &'a mut [f32],
        bias: &'a [f32],
        scale: f32,
        maps: &'a mut [M],
    ) {
        for (value, &bias) in row.iter_mut().zip(bias) {
            *value = relu_scalar(*value * scale + bias);
        }
        M::store(simd, row, maps);
    }
}

/// Computes the gradients of `forward` for `grad_maps` [n, out_h, out_w, out], n >= 1. Entries count only where `maps` is above
/// 0, as in PyTorch. The gradients of weight [k, k, in, out], not yet multiplied by the images' scale, and bias [out] overwrite
/// `packed` and `bias`. The gradient of the images [n, height, width, in] is added to `grad_images`, if that is wanted.
pub(crate) fn backward<S: Simd, M: Element>(
    simd: S,
    layer: &Convolution<S::Element>,
    images: Images<'_, S::Element>,
    maps: &[M],
    grad_maps: &[f32],
    [packed, bias]: [&mut [f32]; 2],
    mut grad_images: Option<&mut [f32]>,
) {
    let (shape, len) = (&layer.shape, layer.shape.image_len());
    let (map_len, out) = (shape.map_len(), shape.channels_out);
    // One image's gradients, 0 where its map is 0, as [locations, out] and as operands of two products.
    let mut masked = Buffer::<f32>::new(map_len);
    let stride = out.next_multiple_of(S::Element::DEPTH);
    let mut rows = Buffer::<S::Element>::new(shape.locations() * stride);
    let mut panels = gradient_panels(simd, shape);
    let mut scratch = [None, None];
    bias.fill(0.0);
    let each = maps
        .chunks_exact(map_len)
        .zip(grad_maps.chunks_exact(map_len));
    for (image, (maps, grad_maps)) in each.enumerate() {
        relu_backward(simd, maps, grad_maps, &mut masked);
        add_locations(simd, &masked, bias);
        let steps = images.steps(simd, image, (len, shape.window_stride()), &mut scratch);
        let mode = if image == 0 { Mode::Replace } else { Mode::Add };
        weight_gradient(simd, shape, steps, &masked, &mut panels, packed, mode);
        if let Some(grad_images) = &mut grad_images {
            write_rows(simd, &masked, out, stride, &mut rows);
            let pixels = &mut grad_images[image * len..(image + 1) * len];
            image_gradient(simd, layer, &rows, pixels);
        }
    }
}

vectorized! {
    /// Computes the gradients before a ReLU whose output was `active`.
    pub(crate) fn relu_backward<S, M>(simd, active: &'a [M], grads: &'a [f32], to: &'a mut [f32]) {
        for ((to, active), &grad) in to.iter_mut().zip(active).zip(grads) {
            *to = relu_gradient(active.value(), grad);
        }
    }

    /// Adds each location of `map` [locations, out] to `sums` [out].
    pub(crate) fn add_locations<S>(simd, map: &'a [f32], sums: &'a mut [f32]) {
        each_block!(sums.len(), add_channels(map, sums));
    }
}

/// [`add_locations`] of `N` channels, whose sums stay in a register.
#[inline(always)]
fn add_channels<const N: usize>(first: usize, map: &[f32], sums: &mut [f32]) {
    let mut each = [0.0; N];
    each.copy_from_slice(&sums[first..][..N]);
    for location in map.chunks_exact(sums.len()) {
        for (sum, value) in each.iter_mut().zip(&location[first..][..N]) {
            *sum += value;
        }
    }
    sums[first..][..N].copy_from_slice(&each);
}

/// Allocates panels for the gradient of one image's map.
pub(crate) fn gradient_panels<S: Simd>(simd: S, shape: &ConvShape) -> Panels<S::Element> {
    let steps = shape.out_height() * shape.out_width().div_ceil(S::Element::DEPTH);
    Panels::new(simd, steps, shape.channels_out)
}

/// Computes one image's part of the weight's gradient: transposed windows times the gradient `grad_map`
/// [locations, out]. `panels` is scratch memory from [`gradient_panels`], `image` is from [`Images::steps`].
pub(crate) fn weight_gradient<S: Simd>(
    simd: S,
    shape: &ConvShape,
    image: &[S::Element],
    grad_map: &[f32],
    panels: &mut Panels<S::Element>,
    packed: &mut [f32],
    mode: Mode,
) {
    let (depth, out) = (S::Element::DEPTH, shape.channels_out);
    let gradients = Matrix::new(grad_map, shape.locations(), out);
    panels.fill(simd, gradients, shape.out_width(), Threads::Caller);
    for kernel_y in 0..shape.kernel {
        let rows = &mut packed[kernel_y * shape.run_len() * out..][..shape.run_len() * out];
        for (first, count) in row_tiles::<S>(shape.run_len(), panels.vecs()) {
            let left = LeftOperand {
                values: image,
                start: (kernel_y * shape.line_len() + first) * depth,
                row_stride: depth,
                step_stride: depth * depth * shape.window_stride(),
                steps: shape.out_width().div_ceil(depth),
                run_stride: shape.stride * shape.line_len() * depth,
                runs: shape.out_height(),
            };
            panels.multiply(simd, count, left, mode, &mut rows[first * out..], out);
        }
    }
}

/// Adds the gradient of one image: the masked gradients times the weight, each added to its window.
fn image_gradient<S: Simd>(
    simd: S,
    layer: &Convolution<S::Element>,
    grad_rows: &[S::Element],
    image: &mut [f32],
) {
    let shape = &layer.shape;
    let stride = shape.channels_out.next_multiple_of(S::Element::DEPTH);
    let left = LeftOperand::rows(grad_rows, stride);
    for y in 0..shape.out_height() {
        for (kernel_y, panels) in layer.backward.iter().enumerate() {
            let line = (y * shape.stride + kernel_y) * shape.line_len();
            for (x, windows) in row_tiles::<S>(shape.out_width(), panels.vecs()) {
                let left = LeftOperand {
                    start: (y * shape.out_width() + x) * stride,
                    ..left
                };
                let out = &mut image[line + x * shape.window_stride()..];
                panels.multiply(simd, windows, left, Mode::Add, out, shape.window_stride());
            }
        }
    }
}
