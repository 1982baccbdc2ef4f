//! Dot products of every anchor with every candidate, location by location, as one candle operation with gradients.
//! It makes no score of them; it runs on the CPU only.
//!
//! Products are f32 in every precision: gradients of scores that cancel each other would be lost in bf16, and they are few.

use candle_core::{CpuStorage, CustomOp2, Layout, Result, Shape, Tensor, bail};
use rayon::prelude::*;

use crate::kernels::buffer::{Buffer, Scalars};
use crate::kernels::isa::Mode;
use crate::kernels::panels::{Matrix, Threads};
use crate::kernels::precision::Precision;
use crate::kernels::product::Product;
use crate::kernels::tensors::{floats, values_of};

/// Dot products [L, B, B] of `psi` and `phi`, each [B, L, R], or [B, R] where one vector meets every location of the other.
///
/// Entry (l, i, j) is psi of row i times phi of row j, at location l. Differentiable in both; all f32. Results and gradients have
/// the same bits whatever the number of threads.
pub(crate) fn dot_products(psi: &Tensor, phi: &Tensor) -> Result<Tensor> {
    let sizes = |vectors: &Tensor| match *vectors.dims() {
        [rows, embedding_dim] => Some((rows, 1, embedding_dim)),
        [rows, locations, embedding_dim] => Some((rows, locations, embedding_dim)),
        _ => None,
    };
    let (Some(anchors), Some(candidates)) = (sizes(psi), sizes(phi)) else {
        bail!("dot products of {:?} and {:?}", psi.shape(), phi.shape());
    };
    let locations = anchors.1.max(candidates.1);
    let meets = |own: usize| own == locations || own == 1;
    let fits = (anchors.0, anchors.2) == (candidates.0, candidates.2)
        && meets(anchors.1)
        && meets(candidates.1)
        && psi.elem_count() * phi.elem_count() > 0;
    if !fits {
        bail!("dot products of {:?} and {:?}", psi.shape(), phi.shape());
    }
    let op = Dots {
        rows: anchors.0,
        embedding_dim: anchors.2,
        locations,
        psi_locations: anchors.1,
        phi_locations: candidates.1,
    };
    psi.contiguous()?.apply_op2(&phi.contiguous()?, op)
}

struct Dots {
    rows: usize,
    embedding_dim: usize,
    locations: usize,
    psi_locations: usize,
    phi_locations: usize,
}

impl Dots {
    /// The vectors [B, R] of location `at` among `vectors` [B, locations, R].
    fn located<'a>(&self, vectors: &'a [f32], locations: usize, at: usize) -> Scalars<'a, f32> {
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
        Product::new(Precision::F32, a, b).on(match self.locations {
            1 => Threads::Pool,
            _ => Threads::Caller,
        })
    }

    /// For each location the product of `grad` [L, B, B], or of its transposed, with the others' vectors, as the gradient [B, own
    /// locations, R].
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
                let others = self.located(others, others_locations, at);
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

impl CustomOp2 for Dots {
    fn name(&self) -> &'static str {
        "dot-products"
    }

    fn cpu_fwd(
        &self,
        psi: &CpuStorage,
        psi_layout: &Layout,
        phi: &CpuStorage,
        phi_layout: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        let (psi, phi) = (floats(psi, psi_layout)?, floats(phi, phi_layout)?);
        let (rows, embedding_dim) = (self.rows, self.embedding_dim);
        let mut dots = vec![0.0; self.locations * rows * rows];
        dots.par_chunks_exact_mut(rows * rows)
            .enumerate()
            .for_each(|(at, dots)| {
                let psi = self.located(psi, self.psi_locations, at);
                let phi = self.located(phi, self.phi_locations, at);
                let psi = Matrix::new(&psi, rows, embedding_dim);
                let phi = Matrix::new(&phi, rows, embedding_dim).transposed();
                self.product(psi, phi).write(dots, Mode::Replace);
            });
        Ok((CpuStorage::F32(dots), (self.locations, rows, rows).into()))
    }

    fn bwd(
        &self,
        psi: &Tensor,
        phi: &Tensor,
        _dots: &Tensor,
        grad: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>)> {
        let grad = grad.detach().contiguous()?;
        let grad = values_of(&grad)?;
        let (psi_values, phi_values) = (values_of(psi)?, values_of(phi)?);
        let (own, others) = (self.psi_locations, self.phi_locations);
        let grad_psi = psi.track_op().then(|| {
            let sum = self.gradient(&grad, false, own, &phi_values, others);
            Tensor::from_vec(sum, psi.shape(), psi.device())
        });
        let grad_phi = phi.track_op().then(|| {
            let sum = self.gradient(&grad, true, others, &psi_values, own);
            Tensor::from_vec(sum, phi.shape(), phi.device())
        });
        Ok((grad_psi.transpose()?, grad_phi.transpose()?))
    }
}
