//! A fully connected layer for an actor: on slices, on the calling thread.
//! It has no gradient; `linear` has one.

use crate::kernels::bordered::store_relu;
use crate::kernels::buffer::Buffer;
use crate::kernels::isa::{AnySimd, Element, LeftOperand, Mode, Simd, with_simd};
use crate::kernels::panels::{Matrix, Panels, Threads};
use crate::kernels::precision::Precision;
use crate::layers::Layer;

pub(crate) struct Dense<S: Simd> {
    simd: S,
    weight: Panels<S::Element>,
    bias: Vec<f32>,
    inputs: usize,
}

/// A fully connected layer after a ReLU, for any instruction set: computes [n, out] from relu(`hidden`) [n, in].
pub(crate) type ReluLayer = Box<dyn Fn(&[f32]) -> Buffer<f32> + Send + Sync>;

/// Builds the layer for the fastest instruction set of this processor.
pub(crate) fn build_relu_layer(
    precision: Precision,
    Layer { weight, bias }: Layer<Vec<f32>>,
) -> ReluLayer {
    with_simd!(AnySimd::fastest(precision), simd => {
        let layer = Dense::new(simd, &weight, bias);
        Box::new(move |hidden: &[f32]| layer.forward_relu(hidden))
    })
}

impl<S: Simd> Dense<S> {
    /// Builds a layer of `weight` [out, in] and `bias` [out].
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

    /// Builds a layer of `weight` [out, in] and `bias` [out] on maps of `channels`. The layer reads inputs in
    /// the order row, column, channel; PyTorch's weight has channel, row, column.
    pub(crate) fn for_maps(simd: S, weight: &[f32], bias: Vec<f32>, channels: usize) -> Self {
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

    /// Computes [n, out] of `x` [n, in].
    pub(crate) fn forward(&self, x: Buffer<S::Element>) -> Buffer<f32> {
        let (outputs, simd) = (self.bias.len(), self.simd);
        let count = x.len() / self.inputs;
        let mut y = Buffer::new(count * outputs);
        for row in y.chunks_exact_mut(outputs) {
            row.copy_from_slice(&self.bias);
        }
        let x = pad_rows(x, self.inputs);
        let left = LeftOperand::rows(&x, self.inputs.next_multiple_of(S::Element::DEPTH));
        self.weight
            .multiply_rows(simd, count, left, Mode::Add, &mut y, outputs);
        y
    }

    fn forward_relu(&self, hidden: &[f32]) -> Buffer<f32> {
        let mut active = Buffer::<S::Element>::new(hidden.len());
        store_relu(self.simd, hidden, &mut active);
        self.forward(active)
    }
}

/// Pads rows of `len` scalars with zeros to whole steps of `DEPTH`.
fn pad_rows<E: Element>(rows: Buffer<E>, len: usize) -> Buffer<E> {
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
