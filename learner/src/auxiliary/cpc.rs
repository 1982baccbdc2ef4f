//! CPC: one InfoNCE for each offset 1, .., P, with DIM's heads, which all offsets share.
//! It holds no parameters, and has no recurrent context: s_t, with its stack of frames, is the context.

use std::ops::Range;

use candle_core::Tensor;
use driml_model::DimHeads;

use super::{
    dim::{Dim, HeadVectors},
    loss::{AuxiliaryLoss, LossInputs, MenuItem, Passes, WeightedLoss},
    positives::Positives,
};
use crate::{
    batch::Batch,
    deduplicate::StateBytes,
    error::Result,
    losses::{info_nce::info_nce_loss, scores::DotProducts},
};

/// The menu item of CPC.
pub const CPC: MenuItem = MenuItem {
    name: "cpc",
    positives: Positives::Several,
    loss_names: &NAMES,
    make: |settings| {
        let dim = Dim::new(settings)?;
        Ok(Box::new(Cpc { dim }))
    },
};

/// The name under which each pair's loss is reported, in the order of `settings::PAIRS`.
const NAMES: [&str; 4] = ["cpc_3t3", "cpc_3t4", "cpc_4t3", "cpc_4t4"];

/// The CPC loss's settings, which are DIM's.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Cpc {
    /// Weights of the pairs, and the clip of their scores.
    dim: Dim,
}

impl AuxiliaryLoss for Cpc {
    fn heads(&self, action: bool) -> DimHeads {
        self.dim.heads(action)
    }

    fn passes(&self, positives: usize, augmented: bool) -> Passes {
        Passes::for_pairs(self.dim.lambda, positives, augmented)
    }

    /// The positives that exist, offset by offset; nothing is computed for missing ones.
    fn later_states<'a>(&self, batch: &Batch<'a>, state_bytes: usize) -> Vec<StateBytes<'a>> {
        let states = batch.positive_states(state_bytes);
        states.into_iter().filter(Option::is_some).collect()
    }

    /// Computes, for each pair with a weight above 0, the mean over the P offsets of the InfoNCE of the rows that have a positive there.
    /// An offset with fewer than two such rows counts as 0. It is a mean so that a lambda weighs as much as in DIM.
    ///
    /// Source: van den Oord et al. 2018, section 2.3, with the heads of Mazoure et al. 2020 ("exactly the same networks
    /// for measuring similarity").
    fn losses(&self, inputs: &LossInputs<'_>) -> Result<Vec<WeightedLoss>> {
        let mut offsets = self.dot_products_by_offset(inputs)?;
        let (kernels, tanh_clip) = (inputs.online.kernels(), self.dim.tanh_clip);
        let pairs = NAMES.into_iter().zip(self.dim.lambda.values());
        let mut losses = Vec::new();
        for (pair, (name, weight)) in pairs.enumerate().filter(|(_, (_, weight))| *weight > 0.0) {
            let dots = offsets.iter_mut().filter_map(|offset| offset[pair].take());
            let dots: Vec<DotProducts> = dots.collect();
            let each = dots.iter().map(|dots| {
                let all = vec![1; dots.values.dim(1)?];
                info_nce_loss(dots, &all, tanh_clip, kernels)
            });
            let loss = match each.reduce(|sum, loss| sum? + loss?) {
                Some(sum) => sum?.affine(1.0 / inputs.batch.positives as f64, 0.0)?,
                None => Tensor::new(0f32, inputs.features.anchors.f4.device())?,
            };
            losses.push(WeightedLoss {
                name,
                weight,
                loss,
                dot_products: dots,
            });
        }
        Ok(losses)
    }
}

impl Cpc {
    /// The dot products, by pair of levels, for each offset at which two rows or more have a positive; only these rows take part.
    fn dot_products_by_offset(
        &self,
        inputs: &LossInputs<'_>,
    ) -> Result<Vec<[Option<DotProducts>; 4]>> {
        let Some(later) = &inputs.features.later else {
            return Ok(Vec::new());
        };
        let (batch, active) = (inputs.batch, self.dim.lambda.active_pairs());
        let (anchors, action) = (&inputs.features.anchors, inputs.action()?);
        let vectors = HeadVectors::new(inputs.online, anchors, later, &action, active)?;
        let (mut offsets, mut first) = (Vec::new(), 0);
        for valid in batch.positive_valid.chunks_exact(batch.rows) {
            let present = (0..).zip(valid).filter(|(_, valid)| **valid != 0);
            let rows: Vec<u32> = present.map(|(row, _)| row).collect();
            let candidates = first..first + rows.len();
            first = candidates.end;
            if rows.len() >= 2 {
                let selected = vectors_at_offset(&vectors, batch.rows, &rows, candidates)?;
                offsets.push(selected.dot_products(active)?);
            }
        }
        Ok(offsets)
    }
}

/// The vectors of one offset: psi of the rows in `anchors`, phi of the positives in `candidates`.
fn vectors_at_offset(
    vectors: &HeadVectors,
    rows: usize,
    anchors: &[u32],
    candidates: Range<usize>,
) -> candle_core::Result<HeadVectors> {
    let mut selected = vectors.clone();
    for psi in selected.psi.iter_mut().flatten() {
        if anchors.len() < rows {
            let indices = Tensor::from_slice(anchors, anchors.len(), psi.device())?;
            *psi = psi.index_select(&indices, 0)?;
        }
    }
    for phi in selected.phi.iter_mut().flatten() {
        *phi = phi.narrow(0, candidates.start, candidates.len())?;
    }
    Ok(selected)
}
