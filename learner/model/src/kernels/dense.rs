//! A fully connected layer as an actor applies it, on slices, on the calling thread.
//! It has no gradient; `linear` is the layer with one.

use crate::kernels::bordered::store_active;
use crate::kernels::buffer::Buffer;
use crate::kernels::isa::{AnySimd, Element, Left, Mode, Simd, with_simd};
use crate::kernels::panels::{Matrix, Panels, Threads};
use crate::kernels::precision::Precision;
use crate::layers::Layer;

pub(crate) struct Dense<S: Simd> {
    simd: S,
    weight: Panels<S::Element>,
    bias: Vec<f32>,
    inputs: usize,
}

/// A layer on what passes a ReLU first, whatever multiplies it.
pub(crate) trait ActiveLayer: Send + Sync {
    /// [n, out] of relu(`hidden`) [n, in].
    fn forward_active(&self, hidden: &[f32]) -> Buffer<f32>;
}

/// The layer for the fastest instruction set of this processor.
pub(crate) fn active_layer(
    precision: Precision,
    Layer { weight, bias }: Layer<Vec<f32>>,
) -> Box<dyn ActiveLayer> {
    with_simd!(AnySimd::of(precision), simd => Box::new(Dense::new(simd, &weight, bias)))
}

impl<S: Simd> ActiveLayer for Dense<S> {
    fn forward_active(&self, hidden: &[f32]) -> Buffer<f32> {
        let count = hidden.len() / self.inputs;
        let mut active = Buffer::<S::Element>::new(count * self.row_len());
        activate(self.simd, hidden, self.inputs, &mut active);
        self.forward(&active, count)
    }
}

impl<S: Simd> Dense<S> {
    /// `weight` [out, in], `bias` [out].
    fn new(simd: S, weight: &[f32], bias: Vec<f32>) -> Self {
        let inputs = weight.len() / bias.len();
        let weight = Matrix::new(weight, bias.len(), inputs).transposed();
        Self {
            simd,
            weight: Panels::pack(simd, weight, Threads::Caller),
            bias,
            inputs,
        }
    }

    /// A layer of `weight` [out, in] and `bias` [out] on maps of `channels`, whose inputs are row, column, channel here, and channel, row,
    /// column in PyTorch's weight.
    pub(crate) fn of_maps(simd: S, weight: &[f32], bias: Vec<f32>, channels: usize) -> Self {
        let inputs = weight.len() / bias.len();
        let locations = inputs / channels;
        let mut by_location = Vec::with_capacity(weight.len());
        for row in weight.chunks_exact(inputs) {
            let column = |input| input % channels * locations + input / channels;
            by_location.extend((0..inputs).map(|input| row[column(input)]));
        }
        Self::new(simd, &by_location, bias)
    }

    pub(crate) const fn inputs(&self) -> usize {
        self.inputs
    }

    /// Scalars of a row of inputs, which begins at a whole step.
    pub(crate) fn row_len(&self) -> usize {
        self.inputs.next_multiple_of(S::Element::DEPTH)
    }

    /// [count, out] of `x` [count, in], rows of [`Dense::row_len`].
    pub(crate) fn forward(&self, x: &[S::Element], count: usize) -> Buffer<f32> {
        let (outputs, simd) = (self.bias.len(), self.simd);
        let mut y = Buffer::new(count * outputs);
        for row in y.chunks_exact_mut(outputs) {
            row.copy_from_slice(&self.bias);
        }
        let left = Left::rows(x, self.row_len());
        self.weight
            .multiply_rows(simd, count, left, Mode::Add, &mut y, outputs);
        y
    }
}

/// Rows of `len` scalars as rows of whole steps.
pub(crate) fn whole_steps<E: Element>(rows: Buffer<E>, len: usize) -> Buffer<E> {
    let stride = len.next_multiple_of(E::DEPTH);
    if stride == len {
        return rows;
    }
    let mut padded = Buffer::new(rows.len() / len * stride);
    for (padded, row) in padded.chunks_exact_mut(stride).zip(rows.chunks_exact(len)) {
        padded[..len].copy_from_slice(row);
        padded[len..].fill(E::default());
    }
    padded
}

/// relu of `hidden` [rows, cols] as rows of whole steps.
fn activate<S: Simd>(simd: S, hidden: &[f32], cols: usize, active: &mut [S::Element]) {
    let rows = active.chunks_exact_mut(cols.next_multiple_of(S::Element::DEPTH));
    for (row, hidden) in rows.zip(hidden.chunks_exact(cols)) {
        let (begin, end) = row.split_at_mut(cols);
        store_active(simd, hidden, begin);
        end.fill(S::Element::default());
    }
}
