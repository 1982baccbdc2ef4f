//! The fully connected layer, on rows or on maps, and ReLU, as candle operations with gradients.
//! This module knows no network and runs on the CPU only.
//!
//! candle's own layer is a matrix product and a broadcast addition, whose backward pass sums the bias on a
//! single thread. candle's ReLU passes a gradient at exactly 0, unlike PyTorch's.

use std::ops::Deref;

use candle_core::{CpuStorage, CustomOp1, Layout, Result, Shape, Tensor, bail};
use rayon::prelude::*;

use crate::gradients;
use crate::kernels::buffer::Buffer;
use crate::kernels::isa::{AnySimd, Mode, with_simd};
use crate::kernels::operation::{Operation, apply_op3};
use crate::kernels::panels::Matrix;
use crate::kernels::precision::Precision;
use crate::kernels::product::Product;
use crate::kernels::rounding::transpose;
use crate::kernels::tensors::{Input, floats, values_of};

/// Rows that one task sums. The number is fixed, so that the order of additions does not depend on the number of threads.
const TASK_ROWS: usize = 256;
/// Scalars that one task of an elementwise pass takes.
const TASK_LEN: usize = 1 << 15;

/// Scalars of a sum of vectors that one task takes.
const TASK_SUM_LEN: usize = 1 << 12;

/// y = x w^T + b, differentiable in all arguments.
///
/// `x` [..., in]; `w` [out, in]; `b` [out]. Result [..., out]. All f32. Operands of products are rounded to `precision`, and the
/// error of each result and gradient is at most [`Precision::product_error`]. Their bits do not depend on the number of threads.
pub fn linear(x: &Tensor, w: &Tensor, b: &Tensor, precision: Precision) -> Result<Tensor> {
    apply(x, w, b, None, precision)
}

/// [`linear`] on maps [B, height, width, channels], flattened as PyTorch's weights expect: channel, row, column.
pub(crate) fn linear_of_maps(
    maps: &Tensor,
    w: &Tensor,
    b: &Tensor,
    precision: Precision,
) -> Result<Tensor> {
    let (_, height, width, channels) = maps.dims4()?;
    apply(maps, w, b, Some((height * width, channels)), precision)
}

/// max(x, 0). Its gradient at exactly 0 is 0, as in PyTorch.
pub fn relu(x: &Tensor) -> Result<Tensor> {
    x.contiguous()?.apply_op1(Relu)
}

/// Applies the layer. `maps` is (locations, channels) if x must be flattened.
fn apply(
    x: &Tensor,
    w: &Tensor,
    b: &Tensor,
    maps: Option<(usize, usize)>,
    precision: Precision,
) -> Result<Tensor> {
    let inputs = match maps {
        Some((locations, channels)) => locations * channels,
        None => x.dims().last().copied().unwrap_or(0),
    };
    let outputs = w.dims().first().copied().unwrap_or(0);
    let fits = w.dims() == [outputs, inputs] && b.dims() == [outputs] && inputs * outputs > 0;
    if !fits {
        let (x, w, b) = (x.shape(), w.shape(), b.shape());
        bail!("linear layer of x {x:?} with weight {w:?} and bias {b:?}");
    }
    let operation = Linear {
        rows: x.elem_count() / inputs,
        inputs,
        outputs,
        maps,
        precision,
    };
    let leading = match maps {
        Some(_) => 1,
        None => x.rank() - 1,
    };
    let shape = [&x.dims()[..leading], &[outputs]].concat();
    apply_op3(operation, [x, w, b], shape)
}

struct Linear {
    rows: usize,
    inputs: usize,
    outputs: usize,
    /// Locations and channels of x, if it is maps [.., locations, channels] to be flattened to [.., channels * locations].
    maps: Option<(usize, usize)>,
    precision: Precision,
}

impl Operation<3> for Linear {
    const NAME: &'static str = "linear";

    /// The flattened maps.
    type Saved = Option<Buffer<f32>>;

    fn forward(&self, [x, w, b]: [Input<'_>; 3]) -> Result<(Vec<f32>, Self::Saved)> {
        let x = x.floats()?;
        let flat = self.maps.map(|(locations, channels)| {
            let mut flat = Buffer::new(x.len());
            transpose_images(x, locations, channels, &mut flat);
            flat
        });
        let x = Matrix::new(flat.as_deref().unwrap_or(x), self.rows, self.inputs);
        let w = Matrix::new(w.floats()?, self.outputs, self.inputs);
        let product = Product::new(self.precision, x, w.transposed());
        let y = product.with_biases(b.floats()?).to_vec();
        Ok((y, flat))
    }

    fn backward(
        &self,
        [x, w, b]: [&Tensor; 3],
        flat: &Self::Saved,
        _y: &Tensor,
        grad_y: &[f32],
    ) -> Result<[Option<Vec<f32>>; 3]> {
        let grad = Matrix::new(grad_y, self.rows, self.outputs);
        let grad_x = x.track_op().then(|| -> Result<Vec<f32>> {
            let w = values_of(w)?;
            let w = Matrix::new(&w, self.outputs, self.inputs);
            let product = Product::new(self.precision, grad, w);
            let Some((locations, channels)) = self.maps else {
                return Ok(product.to_vec());
            };
            let mut grad_flat = Buffer::new(self.rows * self.inputs);
            product.write(&mut grad_flat, Mode::Replace);
            let mut grad_x = vec![0.0; grad_flat.len()];
            transpose_images(&grad_flat, channels, locations, &mut grad_x);
            Ok(grad_x)
        });
        let x = values_of(x)?;
        let x = Matrix::new(flat.as_deref().unwrap_or(&x), self.rows, self.inputs);
        let product = Product::new(self.precision, grad.transposed(), x);
        let grad_w = gradients::accumulate(w, |sum| product.added_to_sum(sum));
        let sums = || group_sums(grad_y, 1, self.outputs);
        let grad_b = gradients::accumulate(b, |sum| add_to_sum(sum, sums()));
        Ok([grad_x.transpose()?, grad_w, grad_b])
    }
}

/// Transposes every image [rows, cols] of a batch.
pub(crate) fn transpose_images(values: &[f32], rows: usize, cols: usize, result: &mut [f32]) {
    // Transposing rounds nothing, so f32 serves both precisions.
    with_simd!(AnySimd::fastest(Precision::F32), simd => {
        result
            .par_chunks_mut(rows * cols)
            .zip(values.par_chunks(rows * cols))
            .with_min_len(16)
            .for_each(|(result, values)| transpose(simd, values, rows, cols, result));
    });
}

/// Sums the rows of each group: `grads` [rows, outputs] to [groups, outputs].
pub(crate) fn group_sums(grads: &[f32], groups: usize, outputs: usize) -> Vec<f32> {
    if groups > 1 {
        let mut sums = vec![0.0; groups * outputs];
        sums.par_chunks_mut(outputs)
            .zip(grads.par_chunks(grads.len() / groups))
            .for_each(|(sum, rows)| add_rows(sum, rows));
        return sums;
    }
    let parts = grads.par_chunks(TASK_ROWS * outputs).map(|rows| {
        let mut sum = vec![0.0; outputs];
        add_rows(&mut sum, rows);
        sum
    });
    add_in_order(&parts.collect::<Vec<_>>(), outputs)
}

/// Adds `part` to the sum so far, if there is one.
pub(crate) fn add_to_sum(sum: Option<Vec<f32>>, part: Vec<f32>) -> Vec<f32> {
    let Some(mut sum) = sum else { return part };
    add_rows(&mut sum, &part);
    sum
}

/// Adds `rows` to `sum` one after the other. Each row is as long as `sum`.
pub(crate) fn add_rows(sum: &mut [f32], rows: &[f32]) {
    for row in rows.chunks_exact(sum.len()) {
        for (sum, value) in sum.iter_mut().zip(row) {
            *sum += value;
        }
    }
}

/// Sums vectors of length `len`, first to last. Without vectors the result is zeros.
pub(crate) fn add_in_order<P>(parts: &[P], len: usize) -> Vec<f32>
where
    P: Deref<Target = [f32]> + Sync,
{
    let Some((first, others)) = parts.split_first() else {
        return vec![0.0; len];
    };
    let mut sum = first.to_vec();
    sum.par_chunks_mut(TASK_SUM_LEN)
        .enumerate()
        .for_each(|(index, sum)| {
            for part in others {
                for (sum, value) in sum.iter_mut().zip(&part[index * TASK_SUM_LEN..]) {
                    *sum += value;
                }
            }
        });
    sum
}

pub(crate) fn relu_in_place(values: &mut [f32]) {
    for value in values {
        *value = relu_scalar(*value);
    }
}

/// max(value, 0). Unlike `f32::max` it keeps NaN, so that a diverged network is noticed.
#[inline(always)]
pub(crate) fn relu_scalar(value: f32) -> f32 {
    if value < 0.0 { 0.0 } else { value }
}

/// Returns the gradient before a ReLU, given the ReLU's output `y` and the gradient `grad` after it.
#[inline(always)]
pub(crate) fn relu_gradient(y: f32, grad: f32) -> f32 {
    if y <= 0.0 { 0.0 } else { grad }
}

struct Relu;

impl CustomOp1 for Relu {
    fn name(&self) -> &'static str {
        "relu"
    }

    fn cpu_fwd(&self, x: &CpuStorage, layout: &Layout) -> Result<(CpuStorage, Shape)> {
        let mut y = floats(x, layout)?.to_vec();
        y.par_chunks_mut(TASK_LEN).for_each(relu_in_place);
        Ok((CpuStorage::F32(y), layout.shape().clone()))
    }

    fn bwd(&self, _x: &Tensor, y: &Tensor, grad_y: &Tensor) -> Result<Option<Tensor>> {
        let grad_y = grad_y.detach().contiguous()?;
        let (y_values, grad_values) = (values_of(y)?, values_of(&grad_y)?);
        let mut result = vec![0.0; y_values.len()];
        result
            .par_chunks_mut(TASK_LEN)
            .zip(y_values.par_chunks(TASK_LEN))
            .zip(grad_values.par_chunks(TASK_LEN))
            .for_each(|((result, y), grad)| {
                for ((result, &y), &grad) in result.iter_mut().zip(y).zip(grad) {
                    *result = relu_gradient(y, grad);
                }
            });
        Tensor::from_vec(result, y.shape(), y.device()).map(Some)
    }
}
