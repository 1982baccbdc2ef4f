//! The fully connected layer as a candle operation with gradients, with optional ReLU or on maps, and ReLU by itself.
//! It knows no network; it runs on the CPU only.
//!
//! candle's own path is a matrix product and a broadcast addition, whose backward pass sums the bias on a single thread,
//! and its ReLU passes a gradient at exactly 0, which PyTorch's does not.

use std::ops::Deref;
use std::sync::{Mutex, PoisonError};

use candle_core::{CpuStorage, CustomOp1, CustomOp3, Layout, Result, Shape, Storage, Tensor, bail};
use rayon::prelude::*;

use crate::gradients;
use crate::kernels::buffer::Buffer;
use crate::kernels::panels::Matrix;
use crate::kernels::precision::Precision;
use crate::kernels::product::Product;
use crate::kernels::rounding::transpose;
use crate::kernels::units::{ForUnit, Mode, Unit, with_unit};

/// Rows that one task sums. Fixed, so that sums are taken in the same order whatever the number of threads.
const TASK_ROWS: usize = 256;
/// Scalars that one task of an elementwise pass takes.
const TASK_LEN: usize = 1 << 15;

/// Scalars of a sum of vectors that one task takes.
const SUM_LEN: usize = 1 << 12;

/// y = x w^T + b, differentiable in all arguments.
///
/// `x` [..., in]; `w` [out, in]; `b` [out], or [groups..., out] where each entry serves an equal share of consecutive
/// rows of `x`. Result [..., out]. All f32. With as many groups as rows this is x w^T + b for a whole tensor b, which
/// saves the separate addition. Operands of products are rounded to `precision`: each result and gradient is right to
/// [`Precision::product_error`]. Results and gradients have the same bits whatever the number of threads.
pub fn linear(x: &Tensor, w: &Tensor, b: &Tensor, precision: Precision) -> Result<Tensor> {
    apply(x, w, b, Form::Plain, precision)
}

/// [`linear`] on maps [B, height, width, channels], flattened in the order of PyTorch's weights: channel, row, column.
pub(crate) fn linear_of_maps(
    maps: &Tensor,
    w: &Tensor,
    b: &Tensor,
    precision: Precision,
) -> Result<Tensor> {
    let (_, height, width, channels) = maps.dims4()?;
    let form = Form::OfMaps {
        locations: height * width,
        channels,
    };
    apply(maps, w, b, form, precision)
}

/// relu(x w^T + b): [`linear`] with the ReLU fused. Where the result is 0 the gradient is 0, as in PyTorch.
pub fn linear_relu(x: &Tensor, w: &Tensor, b: &Tensor, precision: Precision) -> Result<Tensor> {
    apply(x, w, b, Form::WithRelu, precision)
}

/// max(x, 0), whose gradient at exactly 0 is 0, as in PyTorch.
pub fn relu(x: &Tensor) -> Result<Tensor> {
    x.contiguous()?.apply_op1(Relu)
}

fn apply(x: &Tensor, w: &Tensor, b: &Tensor, form: Form, precision: Precision) -> Result<Tensor> {
    let inputs = match form {
        Form::OfMaps {
            locations,
            channels,
        } => locations * channels,
        Form::Plain | Form::WithRelu => x.dims().last().copied().unwrap_or(0),
    };
    let outputs = w.dims().first().copied().unwrap_or(0);
    let fits =
        w.dims() == [outputs, inputs] && b.dims().last() == Some(&outputs) && inputs * outputs > 0;
    let (rows, groups) = (
        x.elem_count() / inputs.max(1),
        b.elem_count() / outputs.max(1),
    );
    if !fits || groups == 0 || rows % groups != 0 {
        bail!(
            "linear layer of x {:?} with weight {:?} and bias {:?}",
            x.shape(),
            w.shape(),
            b.shape()
        );
    }
    let op = Linear {
        rows,
        inputs,
        outputs,
        groups,
        form,
        precision,
        flat: Mutex::new(None),
    };
    x.contiguous()?
        .apply_op3(&w.contiguous()?, &b.contiguous()?, op)
}

/// What a layer does beside x w^T + b.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Form {
    Plain,
    WithRelu,
    /// x are maps [.., locations, channels], to be flattened to [.., channels * locations].
    OfMaps {
        locations: usize,
        channels: usize,
    },
}

struct Linear {
    rows: usize,
    inputs: usize,
    outputs: usize,
    groups: usize,
    form: Form,
    precision: Precision,
    /// The flattened maps: what the forward pass leaves to the backward pass.
    flat: Mutex<Option<Buffer<f32>>>,
}

impl CustomOp3 for Linear {
    fn name(&self) -> &'static str {
        "linear"
    }

    fn cpu_fwd(
        &self,
        x: &CpuStorage,
        x_layout: &Layout,
        w: &CpuStorage,
        w_layout: &Layout,
        b: &CpuStorage,
        b_layout: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        let x = floats(x, x_layout)?;
        let w = Matrix::new(floats(w, w_layout)?, self.outputs, self.inputs);
        let b = floats(b, b_layout)?;
        let biases = Biases {
            values: b,
            outputs: self.outputs,
            each: self.rows / self.groups,
        };
        let biases = |first: usize, rows: &mut [f32]| biases.write(first, rows);
        let relu = |_: usize, rows: &mut [f32]| relu_in_place(rows);
        let product = |x| {
            let x = Matrix::new(x, self.rows, self.inputs);
            Product::new(self.precision, x, w.transposed())
        };
        let mut dims = x_layout.dims().to_vec();
        let y = match self.form {
            Form::Plain => product(x).added_to(&biases).to_vec(),
            Form::WithRelu => product(x).added_to(&biases).then(&relu).to_vec(),
            Form::OfMaps {
                locations,
                channels,
            } => {
                let mut flat = Buffer::new(x.len());
                transpose_each(x, locations, channels, &mut flat);
                let y = product(&flat).added_to(&biases).to_vec();
                *self.flat.lock().unwrap_or_else(PoisonError::into_inner) = Some(flat);
                dims.truncate(2);
                y
            }
        };
        if let Some(last) = dims.last_mut() {
            *last = self.outputs;
        }
        Ok((CpuStorage::F32(y), dims.into()))
    }

    fn bwd(
        &self,
        x: &Tensor,
        w: &Tensor,
        b: &Tensor,
        y: &Tensor,
        grad_y: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>, Option<Tensor>)> {
        let grad_y = if self.form == Form::WithRelu {
            masked(&y.detach(), &grad_y.detach())?
        } else {
            grad_y.detach().contiguous()?
        };
        let (x_storage, x_layout) = x.storage_and_layout();
        let (w_storage, w_layout) = w.storage_and_layout();
        let (grad_storage, grad_layout) = grad_y.storage_and_layout();
        let grad_values = floats(cpu(&grad_storage)?, grad_layout)?;
        let grad = Matrix::new(grad_values, self.rows, self.outputs);
        let device = w.device();

        let grad_x = x.track_op().then(|| -> Result<Tensor> {
            let w = Matrix::new(
                floats(cpu(&w_storage)?, w_layout)?,
                self.outputs,
                self.inputs,
            );
            let product = Product::new(self.precision, grad, w);
            let grad_x = match self.form {
                Form::Plain | Form::WithRelu => product.to_vec(),
                Form::OfMaps {
                    locations,
                    channels,
                } => {
                    let mut grad_flat = Buffer::new(self.rows * self.inputs);
                    product.write(&mut grad_flat, Mode::Replace);
                    let mut grad_x = vec![0.0; grad_flat.len()];
                    transpose_each(&grad_flat, channels, locations, &mut grad_x);
                    grad_x
                }
            };
            Tensor::from_vec(grad_x, x.shape(), device)
        });
        let flat = self.flat.lock().unwrap_or_else(PoisonError::into_inner);
        let x_values = match &*flat {
            Some(flat) => flat,
            None => floats(cpu(&x_storage)?, x_layout)?,
        };
        let x_values = Matrix::new(x_values, self.rows, self.inputs);
        let product = Product::new(self.precision, grad.transposed(), x_values);
        let grad_w = if !w.track_op() || gradients::add_in_place(w, |sum| product.summed(sum)) {
            None
        } else {
            Some(Tensor::from_vec(product.to_vec(), w.shape(), device)?)
        };
        let sums = || group_sums(grad_values, self.groups, self.outputs);
        let grad_b = if !b.track_op() {
            None
        } else if self.groups == self.rows {
            Some(grad_y.reshape(b.shape())?)
        } else if gradients::add_in_place(b, |sum| add_to(sum, sums())) {
            None
        } else {
            Some(Tensor::from_vec(sums(), b.shape(), device)?)
        };
        Ok((grad_x.transpose()?, grad_w, grad_b))
    }
}

/// Transposes every image [rows, cols] of a batch.
fn transpose_each(values: &[f32], rows: usize, cols: usize, result: &mut [f32]) {
    struct Each<'a>(&'a [f32], usize, usize, &'a mut [f32]);
    impl ForUnit for Each<'_> {
        type Output = ();
        fn run<U: Unit>(self, unit: U) {
            let Self(values, rows, cols, result) = self;
            result
                .par_chunks_mut(rows * cols)
                .zip(values.par_chunks(rows * cols))
                .with_min_len(16)
                .for_each(|(result, values)| transpose(unit, values, rows, cols, result));
        }
    }
    // Nothing is rounded.
    with_unit(Precision::F32, Each(values, rows, cols, result));
}

/// Sums of each group's rows: `grads` [rows, outputs] to [groups, outputs].
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

/// `part` and the sum so far, if there is one.
pub(crate) fn add_to(sum: Option<Vec<f32>>, part: Vec<f32>) -> Vec<f32> {
    let Some(mut sum) = sum else { return part };
    add_rows(&mut sum, &part);
    sum
}

/// Biases that products are added to.
#[derive(Clone, Copy)]
pub(crate) struct Biases<'a> {
    /// [groups, outputs]
    pub(crate) values: &'a [f32],
    pub(crate) outputs: usize,
    /// Rows that a group serves.
    pub(crate) each: usize,
}

impl Biases<'_> {
    /// Writes those of the rows from the `first` on.
    pub(crate) fn write(self, first: usize, rows: &mut [f32]) {
        for (row, to) in rows.chunks_exact_mut(self.outputs).enumerate() {
            let group = (first + row) / self.each;
            to.copy_from_slice(&self.values[group * self.outputs..][..self.outputs]);
        }
    }
}

fn add_rows(sum: &mut [f32], rows: &[f32]) {
    for row in rows.chunks_exact(sum.len()) {
        for (sum, value) in sum.iter_mut().zip(row) {
            *sum += value;
        }
    }
}

/// Sum of equally long vectors, first to last; `len` zeros if there are none.
pub(crate) fn add_in_order<P>(parts: &[P], len: usize) -> Vec<f32>
where
    P: Deref<Target = [f32]> + Sync,
{
    let Some((first, others)) = parts.split_first() else {
        return vec![0.0; len];
    };
    let mut sum = first.to_vec();
    sum.par_chunks_mut(SUM_LEN)
        .enumerate()
        .for_each(|(index, sum)| {
            for part in others {
                for (sum, value) in sum.iter_mut().zip(&part[index * SUM_LEN..]) {
                    *sum += value;
                }
            }
        });
    sum
}

pub(crate) fn relu_in_place(values: &mut [f32]) {
    for value in values {
        *value = relu_of(*value);
    }
}

/// max(value, 0); unlike `f32::max` it keeps NaN, so that a diverged network shows.
#[inline(always)]
pub(crate) fn relu_of(value: f32) -> f32 {
    if value < 0.0 { 0.0 } else { value }
}

/// The gradient at ReLU's input, from its output `y` and the gradient there.
#[inline(always)]
pub(crate) fn relu_gradient(y: f32, grad: f32) -> f32 {
    if y <= 0.0 { 0.0 } else { grad }
}

/// `grad` where `y` is above 0, else 0.
fn masked(y: &Tensor, grad: &Tensor) -> Result<Tensor> {
    let grad = grad.contiguous()?;
    let (y_storage, y_layout) = y.storage_and_layout();
    let (grad_storage, grad_layout) = grad.storage_and_layout();
    let y_values = floats(cpu(&y_storage)?, y_layout)?;
    let grad_values = floats(cpu(&grad_storage)?, grad_layout)?;
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
    Tensor::from_vec(result, y.shape(), y.device())
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
        Ok(Some(masked(&y.detach(), &grad_y.detach())?))
    }
}

/// The scalars of a contiguous f32 storage.
pub(crate) fn floats<'a>(storage: &'a CpuStorage, layout: &Layout) -> Result<&'a [f32]> {
    match layout.contiguous_offsets() {
        Some((start, end)) => Ok(&storage.as_slice::<f32>()?[start..end]),
        None => bail!("a tensor of shape {:?} must be contiguous", layout.shape()),
    }
}

/// The storage, which must be on the CPU.
pub(crate) fn cpu(storage: &Storage) -> Result<&CpuStorage> {
    match storage {
        Storage::Cpu(storage) => Ok(storage),
        _ => bail!("this operation runs on the CPU only"),
    }
}
