//! 3 x 3 convolutions with a border of zeros, forward and backward, as unpadded ones of images that have the border in memory.
//! It knows neither tensors nor threads, and nothing of what comes between two convolutions.

use crate::geometry::ConvShape;
use crate::kernels::buffer::{ALIGNMENT, Buffer};
use crate::kernels::convolution::{
    Convolution, add_locations, gradient_panels, multiply_windows, weight_gradient,
};
use crate::kernels::images::{Images, Room};
use crate::kernels::isa::{Element, Mode, Simd, vectorized};
use crate::kernels::linear::relu_of;
use crate::kernels::rounding::{store, store_bytes};

/// What is put into a border.
#[derive(Clone, Copy)]
pub(crate) enum Inside<'a> {
    /// Pixels, which products scale.
    Bytes(&'a [u8]),
    /// Maps as they are.
    Maps(&'a [f32]),
    /// max(x, 0) of maps.
    Active(&'a [f32]),
}

/// Of a shape that is one of [`ConvShape::bordered`]: its input in memory, with a border of zeros, a pixel wide.
impl ConvShape {
    /// Scalars of an input: where a row of a window is an odd number of them, products of pairs read a zero behind the last one.
    /// Whole lines of the cache, so that what lies behind begins with one.
    pub(crate) fn bordered_len<E: Element>(&self) -> usize {
        let all = self.image_len() + E::DEPTH - 1;
        all.next_multiple_of(ALIGNMENT / size_of::<E>())
    }

    /// Row `y` of the maps inside the border.
    pub(crate) const fn inside(&self, y: usize) -> std::ops::Range<usize> {
        let start = ((y + 1) * self.width + 1) * self.channels_in;
        start..start + (self.width - 2) * self.channels_in
    }

    /// Writes the zeros.
    pub(crate) fn clear_border<E: Element>(&self, room: &mut [E]) {
        let mut end = 0;
        for y in 0..self.height - 2 {
            room[end..self.inside(y).start].fill(E::default());
            end = self.inside(y).end;
        }
        room[end..].fill(E::default());
    }

    /// Writes the zeros, and `inside` between them.
    pub(crate) fn put_inside<S: Simd>(&self, simd: S, inside: Inside<'_>, room: &mut [S::Element]) {
        self.clear_border(room);
        let len = (self.width - 2) * self.channels_in;
        for y in 0..self.height - 2 {
            let (from, to) = (y * len..(y + 1) * len, &mut room[self.inside(y)]);
            match inside {
                Inside::Bytes(bytes) => store_bytes(simd, &bytes[from], to),
                Inside::Maps(maps) => store(simd, &maps[from], to),
                Inside::Active(maps) => store_active(simd, &maps[from], to),
            }
        }
    }
}

vectorized! {
    /// Rounds max(x, 0) of `floats` into `values`, which is as long.
    pub(crate) fn store_active<S, M>(simd, floats: &'a [f32], values: &'a mut [M]) {
        for (value, &float) in values.iter_mut().zip(floats) {
            *value = M::of(relu_of(float));
        }
    }
}

/// A convolution with its parameters as the kernels want them.
pub(crate) struct BorderedConvolution<E: Element> {
    forward: Convolution<E>,
    /// What turns the gradient of its output into that of its input: the same with each kernel turned by 180 degrees.
    backward: Option<Convolution<E>>,
}

impl<E: Element> BorderedConvolution<E> {
    /// `shape` is one of [`ConvShape::bordered`], `weight` [out, in, 3, 3], `bias` [out]; `backward` says whether its input will need
    /// a gradient.
    pub(crate) fn new<S: Simd<Element = E>>(
        simd: S,
        shape: ConvShape,
        weight: &[f32],
        bias: &[f32],
        backward: bool,
    ) -> Self {
        let turned = backward.then(|| {
            let of = ConvShape {
                channels_in: shape.channels_out,
                channels_out: shape.channels_in,
                ..shape
            };
            let bias = vec![0.0; shape.channels_in];
            Convolution::new(simd, of, &turned(&shape, weight), &bias, false)
        });
        Self {
            forward: Convolution::new(simd, shape, weight, bias, false),
            backward: turned,
        }
    }

    pub(crate) const fn shape(&self) -> &ConvShape {
        &self.forward.shape
    }

    pub(crate) fn bias(&self) -> &[f32] {
        &self.forward.bias
    }

    /// Convolves an image in its border, row by row: `then` gets the number of each row and its sums [width, out], without bias.
    pub(crate) fn forward<S: Simd<Element = E>>(
        &self,
        simd: S,
        image: &[E],
        then: impl FnMut(usize, &mut [f32]),
    ) {
        let mut row = Buffer::new(self.shape().out_width() * self.shape().channels_out);
        multiply_windows(simd, &self.forward, image, &mut row, then);
    }

    /// The gradient of an image, row by row as [`BorderedConvolution::forward`], for that of its map, `grad_map` [height, width, out].
    ///
    /// # Panics
    /// If it was not made for that.
    pub(crate) fn image_gradient<S: Simd<Element = E>>(
        &self,
        simd: S,
        grad_map: &[f32],
        then: impl FnMut(usize, &mut [f32]),
    ) {
        let backward = self.backward.as_ref();
        let backward = backward.expect("a convolution whose input has a gradient is made for it");
        let mut room = Buffer::new(backward.shape.bordered_len::<E>());
        backward
            .shape
            .put_inside(simd, Inside::Maps(grad_map), &mut room);
        let mut row = Buffer::new(self.shape().out_width() * self.shape().channels_in);
        multiply_windows(simd, backward, &room, &mut row, then);
    }

    /// Adds the gradients of weight [3, 3, in, out] and bias [out] for an image in its border, whose scale the weight's does not have
    /// yet, and the gradient of its map.
    pub(crate) fn parameter_gradients<S: Simd<Element = E>>(
        &self,
        simd: S,
        image: &[E],
        grad_map: &[f32],
        [weight, bias]: [&mut [f32]; 2],
    ) {
        let shape = self.shape();
        let (len, shift) = (shape.image_len(), shape.shift());
        let (mut rooms, mut panels) = ([Room::new(), Room::new()], gradient_panels(simd, shape));
        let images = Images::Maps(&image[..len]);
        let steps = images.steps(simd, 0, (len, shift), &mut rooms);
        weight_gradient(simd, shape, steps, grad_map, &mut panels, weight, Mode::Add);
        add_locations(simd, grad_map, bias);
    }
}

/// `weight` [out, in, 3, 3] as [in, out, 3, 3], each kernel turned by 180 degrees.
fn turned(shape: &ConvShape, weight: &[f32]) -> Vec<f32> {
    let (inputs, taps) = (shape.channels_in, shape.kernel * shape.kernel);
    let mut turned = Vec::with_capacity(weight.len());
    for input in 0..inputs {
        for kernels in weight.chunks_exact(inputs * taps) {
            turned.extend(kernels[input * taps..][..taps].iter().rev());
        }
    }
    turned
}
