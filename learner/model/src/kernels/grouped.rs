//! A fully connected layer of which each row needs one group of outputs: the C51 head for the action that the row took.
//! This module knows no network and runs on the CPU only.
//!
//! Other outputs would be dropped after computing, and their gradients are 0. Rows are sorted by group, so that
//! each group is one product.

use std::ops::Range;

use candle_core::{Result, Tensor, bail};
use rayon::prelude::*;

use crate::gradients;
use crate::kernels::buffer::Buffer;
use crate::kernels::isa::Mode;
use crate::kernels::linear::add_rows;
use crate::kernels::operation::{Operation, apply_op3};
use crate::kernels::panels::Matrix;
use crate::kernels::precision::Precision;
use crate::kernels::product::Product;
use crate::kernels::tensors::{Input, values_of};

/// Computes y_r = x_r w_g^T + b_g with g = `groups[r]`, differentiable in all arguments.
///
/// `x` [rows, in]; `w` [groups * out, in]; `b` [groups * out]; result [rows, out]. All f32; operands of products are
/// rounded to `precision`. The bits of results do not depend on the number of threads.
pub(crate) fn grouped_linear(
    x: &Tensor,
    w: &Tensor,
    b: &Tensor,
    groups: &[u8],
    out: usize,
    precision: Precision,
) -> Result<Tensor> {
    let ((rows, inputs), count) = (x.dims2()?, b.elem_count() / out.max(1));
    let fits = w.dims() == [count * out, inputs] && b.dims() == [count * out];
    let known = groups.iter().all(|&group| usize::from(group) < count);
    if !fits || rows != groups.len() || !known || rows * inputs * out == 0 {
        let (x, w, b, rows) = (x.shape(), w.shape(), b.shape(), groups.len());
        bail!(
            "layer of x {x:?} with weight {w:?}, bias {b:?} and {out} outputs for each of {rows} rows' groups"
        );
    }
    let mut order: Vec<usize> = (0..rows).collect();
    order.sort_by_key(|&row| groups[row]);
    let start = |group: usize| order.partition_point(|&row| usize::from(groups[row]) < group);
    let ranges = (0..count).map(|g| start(g)..start(g + 1)).collect();
    let operation = GroupedLinear {
        order,
        ranges,
        inputs,
        out,
        precision,
    };
    apply_op3(operation, [x, w, b], (rows, out))
}

struct GroupedLinear {
    /// Row indices, sorted by group and ascending within a group.
    order: Vec<usize>,
    /// The range of each group's rows in `order`.
    ranges: Vec<Range<usize>>,
    inputs: usize,
    out: usize,
    precision: Precision,
}

impl GroupedLinear {
    /// Copies the rows of `values`, sorted by group.
    fn sort_rows(&self, values: &[f32]) -> Buffer<f32> {
        let mut sorted = Buffer::new(values.len());
        let len = values.len() / self.order.len();
        let rows = sorted.par_chunks_exact_mut(len).zip(&self.order);
        rows.with_min_len(16)
            .for_each(|(to, &row)| to.copy_from_slice(&values[row * len..][..len]));
        sorted
    }

    /// The inverse of `sort_rows`.
    fn unsort_rows(&self, sorted: &[f32]) -> Vec<f32> {
        let mut values = vec![0.0; sorted.len()];
        let len = sorted.len() / self.order.len();
        for (from, &row) in sorted.chunks_exact(len).zip(&self.order) {
            values[row * len..][..len].copy_from_slice(from);
        }
        values
    }

    /// Calls `each` on the pool with every group, its range in `order`, and its rows of `values`, each `len` scalars long.
    fn for_each_group(
        &self,
        mut values: &mut [f32],
        len: usize,
        each: impl Fn(usize, &Range<usize>, &mut [f32]) + Sync,
    ) {
        let mut tasks = Vec::with_capacity(self.ranges.len());
        for rows in &self.ranges {
            let own = values.split_off_mut(..rows.len() * len);
            tasks.push((rows, own.expect("the groups' rows are those of the values")));
        }
        let tasks = tasks.into_par_iter().enumerate();
        tasks.for_each(|(group, (rows, values))| each(group, rows, values));
    }

    /// Returns a group's rows of a sorted matrix.
    fn group_rows<'a>(sorted: &'a [f32], rows: &Range<usize>, len: usize) -> Matrix<'a> {
        Matrix::new(&sorted[rows.start * len..rows.end * len], rows.len(), len)
    }

    fn group_weight<'a>(&self, w: &'a [f32], group: usize) -> Matrix<'a> {
        let len = self.out * self.inputs;
        Matrix::new(&w[group * len..][..len], self.out, self.inputs)
    }
}

impl Operation<3> for GroupedLinear {
    const NAME: &'static str = "grouped-linear";

    /// x, sorted by group.
    type Saved = Buffer<f32>;

    fn forward(&self, [x, w, b]: [Input<'_>; 3]) -> Result<(Vec<f32>, Self::Saved)> {
        let x = self.sort_rows(x.floats()?);
        let (w, b) = (w.floats()?, b.floats()?);
        let mut y = Buffer::new(self.order.len() * self.out);
        self.for_each_group(&mut y, self.out, |group, rows, y| {
            let x = Self::group_rows(&x, rows, self.inputs);
            let w = self.group_weight(w, group);
            Product::new(self.precision, x, w.transposed())
                .with_biases(&b[group * self.out..][..self.out])
                .write(y, Mode::Replace);
        });
        Ok((self.unsort_rows(&y), x))
    }

    fn backward(
        &self,
        [x, w, b]: [&Tensor; 3],
        sorted: &Self::Saved,
        _y: &Tensor,
        grad_y: &[f32],
    ) -> Result<[Option<Vec<f32>>; 3]> {
        let grad = self.sort_rows(grad_y);
        let grad_x = x.track_op().then(|| -> Result<Vec<f32>> {
            let w = values_of(w)?;
            let mut grad_x = Buffer::new(self.order.len() * self.inputs);
            self.for_each_group(&mut grad_x, self.inputs, |group, rows, grad_x| {
                let grad = Self::group_rows(&grad, rows, self.out);
                let w = self.group_weight(&w, group);
                Product::new(self.precision, grad, w).write(grad_x, Mode::Replace);
            });
            Ok(self.unsort_rows(&grad_x))
        });
        let zeros = |like: &Tensor| vec![0.0; like.elem_count()];
        let grad_w = gradients::accumulate(w, |sum| {
            let mut sum = sum.unwrap_or_else(|| zeros(w));
            let sums = sum.par_chunks_exact_mut(self.out * self.inputs);
            sums.zip(&self.ranges).for_each(|(sum, rows)| {
                let grad = Self::group_rows(&grad, rows, self.out).transposed();
                let x = Self::group_rows(sorted, rows, self.inputs);
                Product::new(self.precision, grad, x).write(sum, Mode::Add);
            });
            sum
        });
        let grad_b = gradients::accumulate(b, |sum| {
            let mut sum = sum.unwrap_or_else(|| zeros(b));
            for (sum, rows) in sum.chunks_exact_mut(self.out).zip(&self.ranges) {
                add_rows(sum, &grad[rows.start * self.out..rows.end * self.out]);
            }
            sum
        });
        Ok([grad_x.transpose()?, grad_w, grad_b])
    }
}
