//! CPC: one InfoNCE for each offset 1, .., P, on the heads that DIM has, which all offsets share.
//! It holds no parameters, and has no recurrent context: s_t, with its stack of frames, is the context.

use std::ops::Range;

use candle_core::Tensor;
use driml_model::{DimHeads, Features, Network};

use super::{
    dim::{Dim, Vectors},
    loss::{AuxiliaryLoss, LossInputs, MenuItem, Passes, WeightedLoss},
    positives::Positives,
};
use crate::{
    batch::Batch,
    deduplicate::State,
    error::UpdateError,
    losses::{info_nce::info_nce_loss, scores::Dots},
};

/// Its line of the menu.
pub const CPC: MenuItem = MenuItem {
    name: "cpc",
    positives: Positives::Several,
    losses: &NAMES,
    make: |settings| {
        settings.check_no_own()?;
        settings.check_weighted()?;
        let pairs = Dim::new(settings);
        Ok(Box::new(Cpc { pairs }))
    },
};

/// What each pair's loss is reported as, in the order of `settings::PAIRS`.
const NAMES: [&str; 4] = ["cpc_3t3", "cpc_3t4", "cpc_4t3", "cpc_4t4"];

/// The CPC loss's settings: those of the pairs of levels.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Cpc {
    /// Weights of the pairs, and how dot products become scores.
    pairs: Dim,
}

/// The dot products of one offset, in the order of `settings::PAIRS`, and the rows that have a positive there.
#[derive(Debug)]
struct Offset {
    /// Rows with a positive, at least two.
    rows: usize,
    /// [L, rows, rows] for the pairs with a weight above 0.
    dots: [Option<Dots>; 4],
}

impl AuxiliaryLoss for Cpc {
    fn heads(&self, action: bool) -> DimHeads {
        self.pairs.heads(action)
    }

    fn passes(&self, positives: usize, augmented: bool) -> Passes {
        Passes::of_pairs(self.pairs.lambda, positives, augmented)
    }

    /// Those that exist, offset by offset: nothing is computed for the others.
    fn later_states<'a>(&self, batch: &Batch<'a>, state_bytes: usize) -> Vec<State<'a>> {
        let states = batch.positive_states(state_bytes);
        states.into_iter().filter(Option::is_some).collect()
    }

    /// For each pair with a weight above 0 the mean over the P offsets of the InfoNCE of the rows that have a positive there, 0
    /// where fewer than two have. A mean, so that lambda weighs as much as DIM's.
    ///
    /// Source: van den Oord et al. 2018, section 2.3, with the heads of Mazoure et al. 2020 ("exactly the same networks
    /// for measuring similarity").
    fn losses(&self, inputs: &LossInputs<'_>) -> Result<Vec<WeightedLoss>, UpdateError> {
        let (online, valid) = (inputs.online, inputs.batch.positive_valid);
        let (anchors, later) = (&inputs.features.anchors, inputs.features.later.as_ref());
        let action = inputs.action()?;
        let offsets = self.offsets(online, anchors, later, &action, valid)?;
        let mut sums = [const { None::<Tensor> }; 4];
        let mut all_dots = [const { Vec::new() }; 4];
        for Offset { rows, dots } in offsets {
            let all = vec![1; rows];
            for ((sum, all_dots), dots) in sums.iter_mut().zip(&mut all_dots).zip(dots) {
                if let Some(dots) = dots {
                    let scores = self.pairs.scores(dots.width);
                    let loss = info_nce_loss(&dots.dots, &all, scores, online.kernels())?;
                    *sum = Some(match sum.take() {
                        Some(sum) => (sum + loss)?,
                        None => loss,
                    });
                    all_dots.push(dots);
                }
            }
        }
        let lambda = self.pairs.lambda.values();
        let mut losses = Vec::new();
        for (((name, weight), sum), dots) in NAMES.into_iter().zip(lambda).zip(sums).zip(all_dots) {
            let loss = match sum {
                Some(sum) => sum.affine(1.0 / inputs.batch.positives as f64, 0.0)?,
                None if weight > 0.0 => Tensor::new(0f32, anchors.f4.device())?,
                None => continue,
            };
            losses.push(WeightedLoss {
                name,
                weight,
                loss,
                dots,
            });
        }
        Ok(losses)
    }
}

impl Cpc {
    /// The dot products of each offset at which two rows or more have a positive.
    ///
    /// `features_t` of s_t, B rows; `features_k` of the positives that exist, offset by offset, none if there are none;
    /// `action` [B]; `valid` [P, B]: 0 where a row has no positive.
    fn offsets(
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
    let mut here = Vectors {
        kernels: vectors.kernels,
        psi: vectors.psi.clone(),
        phi: vectors.phi.clone(),
    };
    for psi in here.psi.iter_mut().flatten() {
        if anchors.len() < rows {
            let indices = Tensor::from_slice(anchors, anchors.len(), psi.device())?;
            *psi = psi.index_select(&indices, 0)?;
        }
    }
    for phi in here.phi.iter_mut().flatten() {
        *phi = phi.narrow(0, candidates.start, candidates.len())?;
    }
    Ok(here)
}
