//! 3 x 3 convolutions with padding 1, forward and backward, as unpadded convolutions of images stored with their border of zeros.
//! This module knows neither tensors nor threads, and nothing of what comes between two convolutions.

use std::ops::Range;

use crate::geometry::ConvShape;
use crate::kernels::buffer::{ALIGNMENT, Buffer};
use crate::kernels::convolution::{
    Convolution, add_locations, gradient_panels, multiply_windows, weight_gradient,
};
use crate::kernels::images::Images;
use crate::kernels::isa::{Element, Mode, Simd, vectorized};
use crate::kernels::linear::relu_scalar;
use crate::kernels::rounding::store;

/// Methods of shapes from [`ConvShape::bordered`]: the input in memory, with a border of zeros one pixel wide.
impl ConvShape {
    /// Returns the scalars of an input in memory. If a window's row has an odd number of scalars, products of pairs read a
    /// zero behind the last one. The length is a whole number of cache lines, so that the next input begins on one.
    pub(crate) fn bordered_len<E: Element>(&self) -> usize {
        let all = self.image_len() + E::DEPTH - 1;
        all.next_multiple_of(ALIGNMENT / size_of::<E>())
    }

    /// Returns the range of row `y` of the maps inside the border.
    pub(crate) const fn interior_row(&self, y: usize) -> Range<usize> {
        let start = ((y + 1) * self.width + 1) * self.channels_in;
        start..start + (self.width - 2) * self.channels_in
    }

    /// Writes the zeros of the border.
    pub(crate) fn clear_border<E: Element>(&self, image: &mut [E]) {
        let mut end = 0;
        for y in 0..self.height - 2 {
            image[end..self.interior_row(y).start].fill(E::default());
            end = self.interior_row(y).end;
        }
        image[end..].fill(E::default());
    }

    /// Writes the zeros of the border. `store_row` writes each row between them, given its range in an image without a border.
    pub(crate) fn write_interior<E: Element>(
        &self,
        image: &mut [E],
        store_row: impl Fn(Range<usize>, &mut [E]),
    ) {
        self.clear_border(image);
        let len = (self.width - 2) * self.channels_in;
        for y in 0..self.height - 2 {
            store_row(y * len..(y + 1) * len, &mut image[self.interior_row(y)]);
        }
    }
}

vectorized! {
    /// Rounds max(x, 0) of `floats` into `values`, which has the same length.
    pub(crate) fn store_relu<S, M>(simd, floats: &'a [f32], values: &'a mut [M]) {
        for (value, &float) in values.iter_mut().zip(floats) {
            *value = M::rounded(relu_scalar(float));
        }
    }
}

/// A convolution with padding 1, its parameters packed for the kernels.
pub(crate) struct BorderedConvolution<E: Element> {
    forward: Convolution<E>,
    /// Turns the output's gradient into the input's: in and out are swapped, and each kernel is rotated by 180 degrees.
    backward: Option<Convolution<E>>,
}

impl<E: Element> BorderedConvolution<E> {
    /// `shape` is from [`ConvShape::bordered`]; `weight` [out, in, 3, 3], `bias` [out]. `backward` says
    /// whether the input needs a gradient.
    pub(crate) fn new<S: Simd<Element = E>>(
        simd: S,
        shape: ConvShape,
        weight: &[f32],
        bias: &[f32],
        backward: bool,
    ) -> Self {
        let rotated = backward.then(|| {
            let swapped = ConvShape {
                channels_in: shape.channels_out,
                channels_out: shape.channels_in,
                ..shape
            };
            let bias = vec![0.0; shape.channels_in];
            Convolution::new(simd, swapped, &rotated_weight(&shape, weight), &bias, false)
        });
        Self {
            forward: Convolution::new(simd, shape, weight, bias, false),
            backward: rotated,
        }
    }

    pub(crate) const fn shape(&self) -> &ConvShape {
        &self.forward.shape
    }

    pub(crate) fn bias(&self) -> &[f32] {
        &self.forward.bias
    }

    /// Convolves an image with its border, row by row: `then` receives each row's index and its sums [width, out], without bias.
    pub(crate) fn forward<S: Simd<Element = E>>(
        &self,
        simd: S,
        image: &[E],
        then: impl FnMut(usize, &mut [f32]),
    ) {
        let mut row = Buffer::new(self.shape().out_width() * self.shape().channels_out);
        multiply_windows(simd, &self.forward, image, &mut row, then);
    }

    /// Computes the gradient of an image from its map's, `grad_map` [height, width, out], row by row as [`BorderedConvolution::forward`].
    pub(crate) fn image_gradient<S: Simd<Element = E>>(
        &self,
        simd: S,
        grad_map: &[f32],
        then: impl FnMut(usize, &mut [f32]),
    ) {
        let backward = self.backward.as_ref();
        let backward = backward.expect("a convolution whose input has a gradient is made for it");
        let mut image = Buffer::<E>::new(backward.shape.bordered_len::<E>());
        backward
            .shape
            .write_interior(&mut image, |from, to| store(simd, &grad_map[from], to));
        let mut row = Buffer::new(self.shape().out_width() * self.shape().channels_in);
        multiply_windows(simd, backward, &image, &mut row, then);
    }

    /// Adds the gradients of weight [3, 3, in, out] and bias [out] for an image with its border and the
    /// gradient of its map. The weight's gradient is not yet multiplied by the image's scale.
    pub(crate) fn parameter_gradients<S: Simd<Element = E>>(
        &self,
        simd: S,
        image: &[E],
        grad_map: &[f32],
        [weight, bias]: [&mut [f32]; 2],
    ) {
        let shape = self.shape();
        let (len, shift) = (shape.image_len(), shape.window_stride());
        let mut scratch = [None, None];
        let mut panels = gradient_panels(simd, shape);
        let images = Images::Maps(&image[..len]);
        let steps = images.steps(simd, 0, (len, shift), &mut scratch);
        weight_gradient(simd, shape, steps, grad_map, &mut panels, weight, Mode::Add);
        add_locations(simd, grad_map, bias);
    }
}

/// Reorders `weight` [out, in, 3, 3] to [in, out, 3, 3] and rotates each kernel by 180 degrees.
fn rotated_weight(shape: &ConvShape, weight: &[f32]) -> Vec<f32> {
    let (inputs, taps) = (shape.channels_in, shape.kernel * shape.kernel);
    let mut rotated = Vec::with_capacity(weight.len());
    for input in 0..inputs {
        for kernels in weight.chunks_exact(inputs * taps) {
            rotated.extend(kernels[input * taps..][..taps].iter().rev());
        }
    }
    rotated
}
