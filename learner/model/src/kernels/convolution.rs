//! Convolution with bias and ReLU over a few images, forward and backward, as products of windows that are read in place.
//! It knows neither tensors nor threads: callers split the batch.
//!
//! Images and maps are channels-last, so a window is one run of kernel * channels_in scalars for each row of the kernel, and
//! windows beside each other lie stride * channels_in scalars apart: a tile's rows, without a copy of any window. The gradient
//! of an image is added straight to the windows it came from.

use crate::geometry::ConvShape;
use crate::kernels::buffer::Buffer;
use crate::kernels::images::{Images, Room};
use crate::kernels::isa::{
    Columns, Element, LANES, Left, Mode, Simd, multiply_tile, row_tiles, tile_vecs, vectorized,
};
use crate::kernels::linear::{relu_gradient, relu_of};
use crate::kernels::panels::{Matrix, Panels, Threads};
use crate::kernels::rounding::write_rows;

impl ConvShape {
    /// Scalars in a row of an image.
    fn line(&self) -> usize {
        self.width * self.channels_in
    }

    /// Scalars in a row of a window.
    fn run(&self) -> usize {
        self.kernel * self.channels_in
    }

    /// Scalars from a window to its right neighbour.
    pub(crate) fn shift(&self) -> usize {
        self.stride * self.channels_in
    }

    /// Weight [out, in, k, k] as [k, k, in, out]: the matrix that windows are multiplied by.
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

    /// The inverse of `pack_weight`, into `weight`.
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

/// One convolution with its parameters as the kernels want them.
pub(crate) struct Convolution<E: Element> {
    pub(crate) shape: ConvShape,
    /// Of the product window x weight: every row of the kernel begins with a new step.
    forward: Panels<E>,
    /// Of the product gradient x weight, for each row of the kernel; there if images get a gradient.
    backward: Vec<Panels<E>>,
    /// For every location of a row: [out_width, out].
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
        let (run, out) = (shape.run(), shape.channels_out);
        let packed = shape.pack_weight(weight);
        let padded_run = run.next_multiple_of(E::DEPTH);
        let mut padded = vec![0.0; shape.kernel * padded_run * out];
        let rows = padded.chunks_exact_mut(padded_run * out);
        for (row, packed) in rows.zip(packed.chunks_exact(run * out)) {
            row[..run * out].copy_from_slice(packed);
        }
        let matrix = Matrix::new(&padded, shape.kernel * padded_run, out);
        let rows = packed.chunks_exact(run * out).filter(|_| backward);
        let backward = rows.map(|row| {
            let matrix = Matrix::new(row, run, out).transposed();
            Panels::pack(simd, matrix, Threads::Caller)
        });
        Self {
            shape,
            forward: Panels::pack(simd, matrix, Threads::Caller),
            backward: backward.collect(),
            bias: bias.repeat(shape.out_width()),
        }
    }
}

/// maps = relu(conv(images, weight) + bias), as `maps` [n, out_height, out_width, out] stores them.
pub(crate) fn forward<S: Simd, M: Element>(
    simd: S,
    layer: &Convolution<S::Element>,
    images: Images<'_, S::Element>,
    maps: &mut [M],
) {
    let shape = &layer.shape;
    let (out_width, out) = (shape.out_width(), shape.channels_out);
    let (mut room, mut row) = (Room::new(), Buffer::new(out_width * out));
    // Where a run is odd, the last step of the last window reads one scalar further, times 0.
    let len = (shape.image_len(), shape.run() % S::Element::DEPTH);
    for (index, maps) in maps.chunks_exact_mut(shape.map_len()).enumerate() {
        let image = images.image(simd, index, len, &mut room);
        let mut lines = maps.chunks_exact_mut(out_width * out);
        multiply_windows(simd, layer, image, &mut row, |_, row| {
            if let Some(maps) = lines.next() {
                finish_row(simd, row, &layer.bias, images.scale(), maps);
            }
        });
    }
}

/// Multiplies the windows of one image by the weight, row by row: `then` gets the number of each row of the map and its sums
/// [out_width, out], which are in `row`. Where a run is odd, an image may have to have a scalar more.
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
            let left = Left {
                values: image,
                start: y * shape.stride * shape.line() + x * shape.shift(),
                row_stride: shape.shift(),
                step: S::Element::DEPTH,
                steps: shape.run().div_ceil(S::Element::DEPTH),
                run_stride: shape.line(),
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
    /// relu(scale * row + bias), there and rounded into `maps`.
    pub(crate) fn finish_row<S, M>(
        simd,
        row: &'a mut [f32],
        bias: &'a [f32],
        scale: f32,
        maps: &'a mut [M],
    ) {
        for (value, &bias) in row.iter_mut().zip(bias) {
            *value = relu_of(*value * scale + bias);
        }
        M::store(simd, row, maps);
    }
}

/// Where `backward` writes gradients of parameters, and adds those of images.
pub(crate) struct ConvGradients<'a> {
    /// [k, k, in, out]
    pub(crate) packed: &'a mut [f32],
    /// [out]
    pub(crate) bias: &'a mut [f32],
    /// [n, height, width, in], or None if the images need none.
    pub(crate) images: Option<&'a mut [f32]>,
}

impl<'a> ConvGradients<'a> {
    /// Those of `shape` at the end of all layers' `sums`, which are shortened by them.
    pub(crate) fn cut<'s: 'a>(
        sums: &mut &'s mut [f32],
        shape: &ConvShape,
        images: Option<&'a mut [f32]>,
    ) -> Self {
        let before = sums.len() - shape.parameters_len();
        let (left, own) = std::mem::take(sums).split_at_mut(before);
        *sums = left;
        let (packed, bias) = own.split_at_mut(shape.weight_len());
        Self {
            packed,
            bias,
            images,
        }
    }
}

/// The gradients of `forward` for `grad_maps` [n, out_h, out_w, out], one image or more, whose entries count only where `maps` is above
/// 0, as in PyTorch. The weight's is still to be multiplied by the images' scale.
pub(crate) fn backward<S: Simd, M: Element>(
    simd: S,
    layer: &Convolution<S::Element>,
    images: Images<'_, S::Element>,
    maps: &[M],
    grad_maps: &[f32],
    mut grads: ConvGradients<'_>,
) {
    let shape = &layer.shape;
    let mut masked = Masked::new::<S>(shape);
    grads.bias.fill(0.0);
    let (len, mut rooms) = (shape.image_len(), [Room::new(), Room::new()]);
    for (image, (maps, grad_maps)) in maps
        .chunks_exact(shape.map_len())
        .zip(grad_maps.chunks_exact(shape.map_len()))
        .enumerate()
    {
        masked.mask(simd, maps, grad_maps, grads.bias);
        let steps = images.steps(simd, image, (len, shape.shift()), &mut rooms);
        let mode = if image == 0 { Mode::Replace } else { Mode::Add };
        let (values, panels) = (&masked.values, &mut masked.panels);
        weight_gradient(simd, shape, steps, values, panels, grads.packed, mode);
        if let Some(grad_images) = &mut grads.images {
            masked.write_rows(simd, shape.channels_out);
            let pixels = &mut grad_images[image * len..(image + 1) * len];
            image_gradient(simd, layer, &masked.rows, pixels);
        }
    }
}

/// One image's gradients where its maps are above 0, as the operands of two products.
struct Masked<E: Element> {
    /// [locations, out]
    values: Buffer<f32>,
    /// [locations, out rounded up to steps]: the left operand of the image's gradient.
    rows: Buffer<E>,
    /// Panels of [rows of maps * steps of windows, columns, DEPTH]: the right operand of the weight's gradient.
    panels: Buffer<E>,
}

impl<E: Element> Masked<E> {
    fn new<S: Simd<Element = E>>(shape: &ConvShape) -> Self {
        let out = shape.channels_out;
        Self {
            values: Buffer::new(shape.map_len()),
            rows: Buffer::new(shape.locations() * out.next_multiple_of(E::DEPTH)),
            panels: gradient_panels::<S>(shape),
        }
    }

    /// Masks one image's gradients, and adds them to the bias's.
    fn mask<S: Simd, M: Element>(
        &mut self,
        simd: S,
        maps: &[M],
        grad_maps: &[f32],
        bias: &mut [f32],
    ) {
        mask(simd, maps, grad_maps, &mut self.values);
        add_locations(simd, &self.values, bias);
    }

    fn write_rows<S: Simd<Element = E>>(&mut self, simd: S, out: usize) {
        let stride = out.next_multiple_of(E::DEPTH);
        write_rows(simd, &self.values, out, stride, &mut self.rows);
    }
}

vectorized! {
    fn mask<S, M>(
        simd,
        maps: &'a [M],
        grad_maps: &'a [f32],
        masked: &'a mut [f32],
    ) {
        for ((masked, map), &grad) in masked.iter_mut().zip(maps).zip(grad_maps) {
            *masked = relu_gradient(map.value(), grad);
        }
    }
}

vectorized! {
    /// Adds each location of `map` [locations, out] to `sums` [out].
    pub(crate) fn add_locations<S>(simd, map: &'a [f32], sums: &'a mut [f32]) {
        let out = sums.len();
        let whole = out - out % LANES;
        for first in (0..whole).step_by(LANES) {
            add_channels::<LANES>(map, first, out, sums);
        }
        for first in whole..out {
            add_channels::<1>(map, first, out, sums);
        }
    }
}

/// [`add_locations`] of `N` channels, whose sums stay in a register.
#[inline(always)]
fn add_channels<const N: usize>(map: &[f32], first: usize, out: usize, sums: &mut [f32]) {
    let mut each = [0.0; N];
    each.copy_from_slice(&sums[first..][..N]);
    for location in map.chunks_exact(out) {
        for (sum, value) in each.iter_mut().zip(&location[first..][..N]) {
            *sum += value;
        }
    }
    sums[first..][..N].copy_from_slice(&each);
}

vectorized! {
    fn write_panels<S>(
        simd,
        values: &'a [f32],
        shape: ConvShape,
        width: usize,
        panels: &'a mut [S::Element],
    ) {
        let (out, out_width, depth) = (shape.channels_out, shape.out_width(), S::Element::DEPTH);
        let panels = panels.chunks_exact_mut(panel_len::<S::Element>(&shape, width));
        for (index, panel) in panels.enumerate() {
            let cols = index * width..out.min((index + 1) * width);
            let mut steps = panel.chunks_exact_mut(width * depth);
            for line in values.chunks_exact(out_width * out) {
                for windows in line.chunks(depth * out) {
                    let second = windows.get(out..).unwrap_or_default();
                    let second = second.get(cols.clone()).unwrap_or_default();
                    if let Some(step) = steps.next() {
                        S::Element::join(simd, &windows[cols.clone()], second, step);
                    }
                }
            }
        }
    }
}

/// Scalars of a panel of masked gradients: the windows of an image, two in a step if steps are pairs, by `width` columns.
fn panel_len<E: Element>(shape: &ConvShape, width: usize) -> usize {
    let steps = shape.out_height() * shape.out_width().div_ceil(E::DEPTH);
    steps * width * E::DEPTH
}

/// Memory for the panels of an image's gradients.
pub(crate) fn gradient_panels<S: Simd>(shape: &ConvShape) -> Buffer<S::Element> {
    let width = tile_vecs::<S>(shape.channels_out) * LANES;
    let panels = shape.channels_out.div_ceil(width);
    Buffer::new(panel_len::<S::Element>(shape, width) * panels)
}

/// One image's part of the weight's gradient: windows, transposed, times the gradients `grad_map` [locations, out], for which `panels`
/// is room from [`gradient_panels`]. `image` is from [`Images::steps`].
pub(crate) fn weight_gradient<S: Simd>(
    simd: S,
    shape: &ConvShape,
    image: &[S::Element],
    grad_map: &[f32],
    panels: &mut [S::Element],
    packed: &mut [f32],
    mode: Mode,
) {
    let (depth, out) = (S::Element::DEPTH, shape.channels_out);
    let vecs = tile_vecs::<S>(out);
    let width = vecs * LANES;
    write_panels(simd, grad_map, *shape, width, panels);
    let steps = shape.out_width().div_ceil(depth);
    for kernel_y in 0..shape.kernel {
        let rows = &mut packed[kernel_y * shape.run() * out..][..shape.run() * out];
        for (first, count) in row_tiles::<S>(shape.run(), vecs) {
            let left = Left {
                values: image,
                start: (kernel_y * shape.line() + first) * depth,
                row_stride: depth,
                step: depth * depth * shape.shift(),
                steps,
                run_stride: shape.stride * shape.line() * depth,
                runs: shape.out_height(),
            };
            let panels = panels.chunks_exact(panel_len::<S::Element>(shape, width));
            for (index, panel) in panels.enumerate() {
                let col = index * width;
                let columns = Columns {
                    out: &mut rows[first * out + col..],
                    stride: out,
                    cols: width.min(out - col),
                    vecs,
                    mode,
                };
                multiply_tile(simd, count, left, panel, columns);
            }
        }
    }
}

/// Adds the gradient of one image: masked gradients times the weight, each to the window it belongs to.
fn image_gradient<S: Simd>(
    simd: S,
    layer: &Convolution<S::Element>,
    grad_rows: &[S::Element],
    image: &mut [f32],
) {
    let shape = &layer.shape;
    let stride = shape.channels_out.next_multiple_of(S::Element::DEPTH);
    let left = Left {
        values: grad_rows,
        start: 0,
        row_stride: stride,
        step: S::Element::DEPTH,
        steps: stride / S::Element::DEPTH,
        run_stride: 0,
        runs: 1,
    };
    for y in 0..shape.out_height() {
        for (kernel_y, panels) in layer.backward.iter().enumerate() {
            let line = (y * shape.stride + kernel_y) * shape.line();
            for (x, windows) in row_tiles::<S>(shape.out_width(), panels.vecs()) {
                let left = Left {
                    start: (y * shape.out_width() + x) * stride,
                    ..left
                };
                let out = &mut image[line + x * shape.shift()..];
                panels.multiply(simd, windows, left, Mode::Add, out, shape.shift());
            }
        }
    }
}
