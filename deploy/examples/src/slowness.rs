//! An auxiliary loss of one's own: features of s_t and of s_{t+k} are to be close to each other, as in slow feature analysis.
//! With nothing to hold them apart all features would become one: its weight stays small, and the return keeps them useful.

use candle_core::{D, DType, Tensor};
use driml_learner::{
    Batch, Positives, UpdateError,
    auxiliary::{
        loss::{AuxiliaryLoss, LossInputs, MenuItem, Passes, WeightedLoss},
        settings::AuxiliarySettings,
    },
};
use driml_model::DimHeads;
use serde::Deserialize;

/// Its line of the menu: `learner.update.auxiliary_loss = "slowness"`, one later state a row, one column `slowness` in `metrics.csv`.
pub(crate) static SLOWNESS: MenuItem = MenuItem {
    name: "slowness",
    positives: Positives::One,
    losses: &["slowness"],
    make,
};

/// Its own table, `[learner.update.slowness]`.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct SlownessSettings {
    /// Weight of the loss in the total, above 0.
    weight: f64,
}

fn make(settings: &AuxiliarySettings<'_>) -> Result<Box<dyn AuxiliaryLoss>, UpdateError> {
    match settings.own()? {
        Some(SlownessSettings { weight }) if weight > 0.0 && weight.is_finite() => {
            Ok(Box::new(Slowness { weight }))
        }
        _ => Err(UpdateError::AuxiliaryLoss(
            "auxiliary_loss = slowness needs a weight above 0: --set learner.update.slowness.weight=0.01".into(),
        )),
    }
}

#[derive(Debug)]
struct Slowness {
    weight: f64,
}

impl AuxiliaryLoss for Slowness {
    /// None: it compares the features themselves.
    fn heads(&self, _action: bool) -> DimHeads {
        DimHeads::NONE
    }

    fn passes(&self, positives: usize, augmented: bool) -> Passes {
        Passes {
            states: positives as u64 + u64::from(augmented),
            ..Passes::default()
        }
    }

    fn later_states<'a>(&self, batch: &Batch<'a>, state_bytes: usize) -> Vec<Option<&'a [u8]>> {
        batch.positive_states(state_bytes)
    }

    /// The mean over the rows with a later state of |f4(s_t) - f4(s_{t+k})|^2 / D, D the width of f4; 0 if no row has one.
    fn losses(&self, inputs: &LossInputs<'_>) -> Result<Vec<WeightedLoss>, UpdateError> {
        let Some(later) = &inputs.features.later else {
            return Ok(Vec::new());
        };
        let now = &inputs.features.anchors.f4;
        let valid = inputs.batch.positive_valid;
        let rows = valid.iter().filter(|&&valid| valid != 0).count().max(1);
        let weights: Vec<f32> = valid
            .iter()
            .map(|&valid| f32::from(u8::from(valid != 0)) / rows as f32)
            .collect();
        let weights = Tensor::from_vec(weights, valid.len(), now.device())?;
        let distances = (now - &later.f4)?.sqr()?.mean(D::Minus1)?;
        let loss = (distances.to_dtype(DType::F32)? * weights)?.sum_all()?;
        Ok(vec![WeightedLoss {
            name: "slowness",
            weight: self.weight,
            loss,
            dots: Vec::new(),
        }])
    }
}
