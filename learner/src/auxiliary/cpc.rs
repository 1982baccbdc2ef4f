//! CPC: one InfoNCE for each offset 1, .., P, on the heads that DIM has, which all offsets share.
//! It holds no parameters, and has no recurrent context: s_t, with its stack of frames, is the context.

use std::{borrow::Cow, ops::Range};

use candle_core::Tensor;
use driml_model::{Features, Network};

use super::dim::{Dim, Dots, Vectors};
use crate::{error::UpdateError, losses::info_nce::info_nce_loss};

/// The CPC objective's settings: those of the pairs of levels.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Cpc {
    /// Weights of the pairs, and how dot products become scores.
    pub pairs: Dim,
}

/// The dot products of one offset, in the order of `dim::PAIRS`, and the rows that have a positive there.
#[derive(Debug)]
pub struct Offset {
    /// Rows with a positive, at least two.
    pub rows: usize,
    /// [L, rows, rows] for the pairs with a weight above 0.
    pub dots: [Option<Dots>; 4],
}

impl Cpc {
    /// Losses of the pairs with a weight above 0, each a scalar, before their weights: the mean over the P offsets of the
    /// InfoNCE of the rows that have a positive there, 0 where fewer than two have.
    ///
    /// `features_t` of s_t, B rows; `features_k` of the positives that exist, offset by offset, none if there are none;
    /// `action` [B]; `valid` [P, B]: 0 where a row has no positive. A mean, so that lambda weighs as much as DIM's.
    /// Source: van den Oord et al. 2018, section 2.3, with the heads of Mazoure et al. 2020 ("exactly the same networks
    /// for measuring similarity").
    ///
    /// # Errors
    /// A head that such a pair needs and `network` lacks, or rows that do not fit.
    pub fn losses(
        &self,
        network: &Network,
        features_t: &Features,
        features_k: Option<&Features>,
        action: &Tensor,
        valid: &[u8],
    ) -> Result<[Option<Tensor>; 4], UpdateError> {
        let offsets = self.offsets(network, features_t, features_k, action, valid)?;
        let positives = valid.len() / action.elem_count().max(1);
        let mut sums = [const { None::<Tensor> }; 4];
        for Offset { rows, dots } in offsets {
            let all = vec![1; rows];
            for (sum, dots) in sums.iter_mut().zip(dots) {
                if let Some(Dots { dots, rkhs }) = dots {
                    let loss =
                        info_nce_loss(&dots, &all, self.pairs.scores(rkhs), network.operations())?;
                    *sum = Some(match sum.take() {
                        Some(sum) => (sum + loss)?,
                        None => loss,
                    });
                }
            }
        }
        let mut losses = [const { None }; 4];
        for ((loss, sum), wanted) in losses.iter_mut().zip(sums).zip(self.pairs.lambda.wanted()) {
            *loss = match (sum, wanted) {
                (Some(sum), _) => Some(sum.affine(1.0 / positives as f64, 0.0)?),
                (None, true) => Some(Tensor::new(0f32, features_t.f4.device())?),
                (None, false) => None,
            };
        }
        Ok(losses)
    }

    /// The dot products of each offset at which two rows or more have a positive; arguments as in [`Cpc::losses`].
    ///
    /// # Errors
    /// As [`Cpc::losses`].
    pub fn offsets(
        &self,
        network: &Network,
        features_t: &Features,
        features_k: Option<&Features>,
        action: &Tensor,
        valid: &[u8],
    ) -> Result<Vec<Offset>, UpdateError> {
        let Some(features_k) = features_k else {
            return Ok(Vec::new());
        };
        let wanted = self.pairs.lambda.wanted();
        let vectors = Vectors::new(network, features_t, features_k, action, wanted)?;
        let rows = action.elem_count();
        let mut offsets = Vec::new();
        let mut first = 0;
        for valid in valid.chunks_exact(rows) {
            let anchors: Vec<u32> = (0..)
                .zip(valid)
                .filter_map(|(row, &valid)| (valid != 0).then_some(row))
                .collect();
            let candidates = first..first + anchors.len();
            first = candidates.end;
            if anchors.len() >= 2 {
                let here = of_offset(&vectors, rows, &anchors, candidates)?;
                offsets.push(Offset {
                    rows: anchors.len(),
                    dots: here.dots(wanted)?,
                });
            }
        }
        Ok(offsets)
    }
}

/// The vectors of one offset: psi of the rows in `anchors`, phi of the positives in `candidates`.
fn of_offset(
    vectors: &Vectors,
    rows: usize,
    anchors: &[u32],
    candidates: Range<usize>,
) -> candle_core::Result<Vectors> {
    let psi = |psi: &Option<Tensor>| {
        let Some(psi) = psi else { return Ok(None) };
        if anchors.len() == rows {
            return Ok(Some(psi.clone()));
        }
        let indices = Tensor::from_slice(anchors, anchors.len(), psi.device())?;
        psi.index_select(&indices, 0).map(Some)
    };
    let phi = |phi: &Option<Tensor>| {
        phi.as_ref()
            .map(|phi| phi.narrow(0, candidates.start, candidates.len()))
            .transpose()
    };
    Ok(Vectors {
        psi3: psi(&vectors.psi3)?,
        phi3: phi(&vectors.phi3)?,
        psi4: psi(&vectors.psi4)?,
        phi4: phi(&vectors.phi4)?,
    })
}

/// Of the positives' states [P, B, ..] those that exist, offset by offset: nothing is computed for the others.
pub fn present<'a>(states: &'a [u8], valid: &[u8]) -> Cow<'a, [u8]> {
    if valid.iter().all(|&valid| valid != 0) {
        return Cow::Borrowed(states);
    }
    let state_bytes = states.len() / valid.len();
    let count = valid.iter().filter(|&&valid| valid != 0).count();
    let mut there = Vec::with_capacity(count * state_bytes);
    for (state, _) in states
        .chunks_exact(state_bytes)
        .zip(valid)
        .filter(|(_, valid)| **valid != 0)
    {
        there.extend_from_slice(state);
    }
    Cow::Owned(there)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn states_without_a_positive_are_left_out() {
        let states = [1, 1, 2, 2, 3, 3, 4, 4];
        assert_eq!(*present(&states, &[1; 4]), states);
        assert_eq!(*present(&states, &[0, 1, 0, 1]), [2, 2, 4, 4]);
        assert!(present(&states, &[0; 4]).is_empty());
    }
}
