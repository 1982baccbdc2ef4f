//! A residual block, out(relu(hidden(x))) + skip(x), as one candle operation with gradients.
//! It knows no action and no level of features; it runs on the CPU only.
//!
//! As three layers, each would hand the other a gradient through candle, which adds every one of them to fresh zeros on a single thread.

use std::sync::{Mutex, PoisonError};

use candle_core::{CpuStorage, CustomOp3, Layout, Result, Shape, Storage, Tensor, bail};
use rayon::prelude::*;

use crate::gradients;
use crate::kernels::buffer::Buffer;
use crate::kernels::linear::{
    cpu, floats, group_sums, relu_gradient, relu_in_place, rows_of_biases,
};
use crate::kernels::panels::{Matrix, Threads};
use crate::kernels::precision::Precision;
use crate::kernels::product::multiply;
use crate::kernels::units::Mode;

/// Scalars of an elementwise pass that one task takes.
const TASK_LEN: usize = 1 << 15;

/// The weights of a block; its operation uses the first columns of `hidden` and `skip`, as many as x has.
#[derive(Clone, Debug)]
pub(crate) struct BlockWeights {
    /// [hidden, features and more]
    pub(crate) hidden: Tensor,
    /// [outputs, hidden]
    pub(crate) out: Tensor,
    /// [outputs, features and more]
    pub(crate) skip: Tensor,
}

/// `out(relu(hidden x + hidden_bias)) + skip x + skip_bias`, [..., outputs], of x [..., features].
///
/// Biases are [groups..., hidden] and [groups..., outputs], as `linear` takes them. Gradients of weights that are variables are
/// summed in place, so that a backward pass has to be one of [`Backward::of`](crate::Backward::of). Results and gradients have the
/// same bits whatever the number of threads.
///
/// # Errors
/// Shapes that do not match, other types; in the backward pass, one that is not `Backward::of`'s.
pub(crate) fn residual_block(
    x: &Tensor,
    hidden_bias: &Tensor,
    skip_bias: &Tensor,
    weights: &BlockWeights,
    precision: Precision,
) -> Result<Tensor> {
    let features = x.dims().last().copied().unwrap_or(0);
    let rows = x.elem_count() / features.max(1);
    let (hidden, hidden_inputs) = weights.hidden.dims2()?;
    let (outputs, out_inputs) = weights.out.dims2()?;
    let (skip_outputs, skip_inputs) = weights.skip.dims2()?;
    let groups = |bias: &Tensor, width: usize| {
        let groups = bias.elem_count() / width;
        (bias.dims().last() == Some(&width) && groups > 0 && rows.is_multiple_of(groups))
            .then_some(groups)
    };
    let (hidden_groups, skip_groups) = (groups(hidden_bias, hidden), groups(skip_bias, outputs));
    let fits = features > 0
        && features <= hidden_inputs.min(skip_inputs)
        && out_inputs == hidden
        && skip_outputs == outputs;
    let (true, Some(hidden_groups), Some(skip_groups)) = (fits, hidden_groups, skip_groups) else {
        bail!(
            "residual block of x {:?} with weights {:?}, {:?}, {:?} and biases {:?}, {:?}",
            x.shape(),
            weights.hidden.shape(),
            weights.out.shape(),
            weights.skip.shape(),
            hidden_bias.shape(),
            skip_bias.shape()
        );
    };
    let block = Block {
        weights: weights.clone(),
        rows,
        features,
        hidden,
        outputs,
        hidden_groups,
        skip_groups,
        precision,
        saved: Mutex::new(None),
    };
    x.contiguous()?
        .apply_op3(&hidden_bias.contiguous()?, &skip_bias.contiguous()?, block)
}

struct Block {
    weights: BlockWeights,
    rows: usize,
    features: usize,
    hidden: usize,
    outputs: usize,
    hidden_groups: usize,
    skip_groups: usize,
    precision: Precision,
    /// relu(hidden(x)) [rows, hidden]: what the forward pass leaves to the backward pass.
    saved: Mutex<Option<Buffer<f32>>>,
}

impl Block {
    /// [m, n] (+)= a b, on the pool.
    fn multiply(&self, out: &mut [f32], mode: Mode, a: Matrix<'_>, b: Matrix<'_>) {
        multiply(self.precision, out, mode, a, b, Threads::Pool);
    }

    /// Adds `grad_y`^T `x` to the gradient of `weight`, of which x's are the first columns.
    fn add_to_weight(
        &self,
        weight: &Tensor,
        grad_y: Matrix<'_>,
        x: Matrix<'_>,
        columns: usize,
    ) -> Result<()> {
        if !weight.is_variable() {
            return Ok(());
        }
        let stride = weight.dims()[1];
        let done = gradients::add_in_place(weight, |sum, there| {
            if columns == stride {
                let mode = if there { Mode::Add } else { Mode::Replace };
                self.multiply(sum, mode, grad_y.transposed(), x);
                return;
            }
            let mut part = Buffer::new(sum.len() / stride * columns);
            self.multiply(&mut part, Mode::Replace, grad_y.transposed(), x);
            sum.par_chunks_mut(stride)
                .zip(part.par_chunks(columns))
                .for_each(|(sum, part)| {
                    for (sum, part) in sum.iter_mut().zip(part) {
                        *sum += part;
                    }
                });
        });
        if !done {
            bail!("the backward pass of a residual block has to be one of Backward::of");
        }
        Ok(())
    }
}

/// The first `columns` columns of a weight, as rows one after the other.
fn first_columns(weight: &Tensor, columns: usize) -> Result<Buffer<f32>> {
    let (rows, stride) = weight.dims2()?;
    let (storage, layout) = weight.storage_and_layout();
    let values = floats(cpu(&storage)?, layout)?;
    let mut part = Buffer::new(rows * columns);
    for (part, row) in part
        .chunks_exact_mut(columns)
        .zip(values.chunks_exact(stride))
    {
        part.copy_from_slice(&row[..columns]);
    }
    Ok(part)
}

fn values_of<'a>(storage: &'a Storage, layout: &Layout) -> Result<&'a [f32]> {
    floats(cpu(storage)?, layout)
}

impl CustomOp3 for Block {
    fn name(&self) -> &'static str {
        "residual-block"
    }

    fn cpu_fwd(
        &self,
        x: &CpuStorage,
        x_layout: &Layout,
        hidden_bias: &CpuStorage,
        hidden_bias_layout: &Layout,
        skip_bias: &CpuStorage,
        skip_bias_layout: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        let x = Matrix::new(floats(x, x_layout)?, self.rows, self.features);
        let weight = first_columns(&self.weights.hidden, self.features)?;
        let weight = Matrix::new(&weight, self.hidden, self.features).transposed();
        let mut hidden = Buffer::new(self.rows * self.hidden);
        let each = self.rows / self.hidden_groups;
        let biases = floats(hidden_bias, hidden_bias_layout)?.chunks_exact(self.hidden);
        let mut rows = hidden.chunks_exact_mut(self.hidden);
        for bias in biases {
            for row in rows.by_ref().take(each) {
                row.copy_from_slice(bias);
            }
        }
        self.multiply(&mut hidden, Mode::Add, x, weight);
        hidden.par_chunks_mut(TASK_LEN).for_each(relu_in_place);

        let biases = floats(skip_bias, skip_bias_layout)?;
        let mut y = rows_of_biases(biases, self.outputs, self.rows / self.skip_groups);
        let skip = first_columns(&self.weights.skip, self.features)?;
        let skip = Matrix::new(&skip, self.outputs, self.features).transposed();
        self.multiply(&mut y, Mode::Add, x, skip);
        let (out_storage, out_layout) = self.weights.out.storage_and_layout();
        let out = values_of(&out_storage, out_layout)?;
        let out = Matrix::new(out, self.outputs, self.hidden).transposed();
        let active = Matrix::new(&hidden, self.rows, self.hidden);
        self.multiply(&mut y, Mode::Add, active, out);
        *self.saved.lock().unwrap_or_else(PoisonError::into_inner) = Some(hidden);

        let mut dims = x_layout.dims().to_vec();
        if let Some(last) = dims.last_mut() {
            *last = self.outputs;
        }
        Ok((CpuStorage::F32(y), dims.into()))
    }

    fn bwd(
        &self,
        x: &Tensor,
        hidden_bias: &Tensor,
        skip_bias: &Tensor,
        _y: &Tensor,
        grad_y: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>, Option<Tensor>)> {
        let grad_y = grad_y.detach().contiguous()?;
        let (grad_storage, grad_layout) = grad_y.storage_and_layout();
        let grad_values = values_of(&grad_storage, grad_layout)?;
        let grad = Matrix::new(grad_values, self.rows, self.outputs);
        let (x_storage, x_layout) = x.storage_and_layout();
        let x_matrix = Matrix::new(values_of(&x_storage, x_layout)?, self.rows, self.features);
        let saved = self.saved.lock().unwrap_or_else(PoisonError::into_inner);
        let Some(hidden) = &*saved else {
            bail!("the backward pass of a residual block comes after its forward pass");
        };
        let active = Matrix::new(hidden, self.rows, self.hidden);

        self.add_to_weight(&self.weights.out, grad, active, self.hidden)?;
        self.add_to_weight(&self.weights.skip, grad, x_matrix, self.features)?;

        let mut grad_hidden = Buffer::new(self.rows * self.hidden);
        let (out_storage, out_layout) = self.weights.out.storage_and_layout();
        let out = Matrix::new(
            values_of(&out_storage, out_layout)?,
            self.outputs,
            self.hidden,
        );
        self.multiply(&mut grad_hidden, Mode::Replace, grad, out);
        grad_hidden
            .par_chunks_mut(TASK_LEN)
            .zip(hidden.par_chunks(TASK_LEN))
            .for_each(|(grads, hidden)| {
                for (grad, &hidden) in grads.iter_mut().zip(hidden) {
                    *grad = relu_gradient(hidden, *grad);
                }
            });
        let grad_matrix = Matrix::new(&grad_hidden, self.rows, self.hidden);
        self.add_to_weight(&self.weights.hidden, grad_matrix, x_matrix, self.features)?;

        let device = x.device();
        let grad_x = if x.track_op() {
            let mut grad_x = vec![0.0; self.rows * self.features];
            let skip = first_columns(&self.weights.skip, self.features)?;
            let skip = Matrix::new(&skip, self.outputs, self.features);
            self.multiply(&mut grad_x, Mode::Replace, grad, skip);
            let weight = first_columns(&self.weights.hidden, self.features)?;
            let weight = Matrix::new(&weight, self.hidden, self.features);
            self.multiply(&mut grad_x, Mode::Add, grad_matrix, weight);
            Some(Tensor::from_vec(grad_x, x.shape(), device)?)
        } else {
            None
        };
        let bias = |bias: &Tensor, grads: &[f32], groups: usize, width: usize| {
            bias.track_op()
                .then(|| {
                    let sums = group_sums(grads, groups, width);
                    Tensor::from_vec(sums, bias.shape(), device)
                })
                .transpose()
        };
        let hidden_grad = bias(hidden_bias, &grad_hidden, self.hidden_groups, self.hidden)?;
        let skip_grad = bias(skip_bias, grad_values, self.skip_groups, self.outputs)?;
        Ok((grad_x, hidden_grad, skip_grad))
    }
}
