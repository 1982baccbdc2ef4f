//! Dot products of every anchor with every candidate, location by location, as one candle operation with gradients.
//! This module computes no scores and runs on the CPU only.
//!
//! Products are f32 in every precision: bf16 would lose gradients of scores that cancel each other, and the products are few.

use candle_core::{Result, Tensor, bail};
use rayon::prelude::*;

use crate::kernels::buffer::{Buffer, Scalars};
use crate::kernels::isa::Mode;
use crate::kernels::operation::{Operation, apply_op2};
use crate::kernels::panels::{Matrix, Threads};
use crate::kernels::precision::Precision;
use crate::kernels::product::Product;
use crate::kernels::tensors::{Input, values_of};

/// Computes dot products [L, B, B] of `psi` and `phi`, each [B, L, R], or [B, R] for a vector paired with every location of the other.
///
/// Entry (l, i, j) is psi of row i times phi of row j at location l. It is differentiable in both; all
/// tensors are f32. The bits of results and gradients do not depend on the number of threads.
pub(crate) fn dot_products(psi: &Tensor, phi: &Tensor) -> Result<Tensor> {
    let sizes = |vectors: &Tensor| match *vectors.dims() {
        [rows, embedding_dim] => (rows, 1, embedding_dim),
        [rows, locations, embedding_dim] => (rows, locations, embedding_dim),
        // Of another rank: no vectors.
        _ => (0, 0, 0),
    };
    let (anchors, candidates) = (sizes(psi), sizes(phi));
    let locations = anchors.1.max(candidates.1);
    let broadcasts = |own: usize| own == locations || own == 1;
    let fits = (anchors.0, anchors.2) == (candidates.0, candidates.2)
        && broadcasts(anchors.1)
        && broadcasts(candidates.1)
        && anchors.0 * anchors.2 * locations > 0;
    if !fits {
        bail!("dot products of {:?} and {:?}", psi.shape(), phi.shape());
    }
    let (rows, psi_locations, embedding_dim) = anchors;
    let operation = DotProducts {
        rows,
        embedding_dim,
        locations,
        psi_locations,
        phi_locations: candidates.1,
    };
    apply_op2(operation, [psi, phi], (locations, rows, rows))
}

struct DotProducts {
    rows: usize,
    embedding_dim: usize,
    locations: usize,
    psi_locations: usize,
    phi_locations: usize,
}

impl DotProducts {
    /// Returns the vectors [B, R] of location `at` in `vectors` [B, locations, R].
    fn vectors_at<'a>(&self, vectors: &'a [f32], locations: usize, at: usize) -> Scalars<'a, f32> {
        if locations == 1 {
            return Scalars::InPlace(vectors);
        }
        let mut copied = Buffer::new(self.rows * self.embedding_dim);
        let rows = vectors.chunks_exact(locations * self.embedding_dim);
        for (to, row) in copied.chunks_exact_mut(self.embedding_dim).zip(rows) {
            to.copy_from_slice(&row[at * self.embedding_dim..][..self.embedding_dim]);
        }
        Scalars::Copied(copied)
    }

    fn product<'a>(&self, a: Matrix<'a>, b: Matrix<'a>) -> Product<'a> {
        Product::new(Precision::F32, a, b).with_threads(match self.locations {
            1 => Threads::Pool,
            _ => Threads::Caller,
        })
    }

    /// Multiplies `grad` [L, B, B], or its transpose, by the others' vectors at each location. Returns the
    /// gradient [B, own locations, R], summed over locations if there is one own location.
    fn gradient(
        &self,
        grad: &[f32],
        transposed: bool,
        own_locations: usize,
        others: &[f32],
        others_locations: usize,
    ) -> Vec<f32> {
        let parts: Vec<Buffer<f32>> = grad
            .par_chunks_exact(self.rows * self.rows)
            .enumerate()
            .map(|(at, grad)| {
                let grad = Matrix::new(grad, self.rows, self.rows);
                let grad = if transposed { grad.transposed() } else { grad };
                let others = self.vectors_at(others, others_locations, at);
                let others = Matrix::new(&others, self.rows, self.embedding_dim);
                let mut part = Buffer::new(self.rows * self.embedding_dim);
                self.product(grad, others).write(&mut part, Mode::Replace);
                part
            })
            .collect();
        let mut sum = vec![0.0; self.rows * own_locations * self.embedding_dim];
        sum.par_chunks_mut(own_locations * self.embedding_dim)
            .enumerate()
            .for_each(|(row, sum)| {
                for (at, part) in parts.iter().enumerate() {
                    let part = &part[row * self.embedding_dim..][..self.embedding_dim];
                    let to =
                        &mut sum[at % own_locations * self.embedding_dim..][..self.embedding_dim];
                    for (to, part) in to.iter_mut().zip(part) {
                        *to += part;
                    }
                }
            });
        sum
    }
}

impl Operation<2> for DotProducts {
    const NAME: &'static str = "dot-products";

    type Saved = ();

    fn forward(&self, [psi, phi]: [Input<'_>; 2]) -> Result<(Vec<f32>, ())> {
        let (psi, phi) = (psi.floats()?, phi.floats()?);
        let (rows, embedding_dim) = (self.rows, self.embedding_dim);
        let mut dots = vec![0.0; self.locations * rows * rows];
        dots.par_chunks_exact_mut(rows * rows)
            .enumerate()
            .for_each(|(at, dots)| {
                let psi = self.vectors_at(psi, self.psi_locations, at);
                let phi = self.vectors_at(phi, self.phi_locations, at);
                let psi = Matrix::new(&psi, rows, embedding_dim);
                let phi = Matrix::new(&phi, rows, embedding_dim).transposed();
                self.product(psi, phi).write(dots, Mode::Replace);
            });
        Ok((dots, ()))
    }

    fn backward(
        &self,
        [psi, phi]: [&Tensor; 2],
        (): &(),
        _dots: &Tensor,
        grad: &[f32],
    ) -> Result<[Option<Vec<f32>>; 2]> {
        let (psi_values, phi_values) = (values_of(psi)?, values_of(phi)?);
        let (own, others) = (self.psi_locations, self.phi_locations);
        let of_psi = || self.gradient(grad, false, own, &phi_values, others);
        let of_phi = || self.gradient(grad, true, others, &psi_values, own);
        Ok([psi.track_op().then(of_psi), phi.track_op().then(of_phi)])
    }
}
