//! A fully connected layer as an actor applies it, on slices, on the calling thread.
//! It has no gradient; `linear` is the layer with one.

use crate::kernels::buffer::Buffer;
use crate::kernels::isa::{Element, Left, Mode, Simd, vectorized};
use crate::kernels::linear::relu_of;
use crate::kernels::panels::{Matrix, Panels, Threads};

pub(crate) struct Dense<S: Simd> {
    /// Of [in, out].
    weight: Panels<S::Element>,
    bias: Vec<f32>,
    inputs: usize,
}

impl<S: Simd> Dense<S> {
    /// `weight` [in, out], `bias` [out].
    pub(crate) fn new(simd: S, weight: &[f32], bias: Vec<f32>) -> Self {
        let inputs = weight.len() / bias.len();
        let weight = Matrix::new(weight, inputs, bias.len());
        Self {
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
        let mut inputs_first = Vec::with_capacity(weight.len());
        for input in 0..inputs {
            let column = input % channels * locations + input / channels;
            inputs_first.extend(weight[column..].iter().step_by(inputs));
        }
        Self::new(simd, &inputs_first, bias)
    }

    pub(crate) const fn inputs(&self) -> usize {
        self.inputs
    }

    pub(crate) const fn outputs(&self) -> usize {
        self.bias.len()
    }

    /// [count, out] of `x` [count, in], whose rows begin at whole steps.
    pub(crate) fn forward(&self, simd: S, x: &[S::Element], count: usize) -> Buffer<f32> {
        let outputs = self.bias.len();
        let mut y = Buffer::new(count * outputs);
        for row in y.chunks_exact_mut(outputs) {
            row.copy_from_slice(&self.bias);
        }
        let left = Left::rows(x, self.inputs.next_multiple_of(S::Element::DEPTH));
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

vectorized! {
    /// relu of `hidden` [rows, cols] as rows of whole steps.
    pub(crate) fn activate<S>(simd, hidden: &'a [f32], cols: usize, active: &'a mut [S::Element]) {
        let rows = active.chunks_exact_mut(cols.next_multiple_of(S::Element::DEPTH));
        for (row, hidden) in rows.zip(hidden.chunks_exact(cols)) {
            row.fill(S::Element::default());
            for (value, &hidden) in row.iter_mut().zip(hidden) {
                *value = S::Element::of(relu_of(hidden));
            }
        }
    }
}
