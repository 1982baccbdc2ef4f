//! A custom auxiliary loss with an extra layer: features of s_t predict those of s_{t+1}.
//! Alone, this loss would make all features equal: its weight stays small, and the loss of the return keeps the features useful.
//! Source: the latent dynamics of DeepMDP (Gelada et al. 2019), without the action; no gradient flows through the predicted features.

use candle_core::{D, DType, Tensor};
use driml_learner::{
    Batch, Positives, UpdateError,
    auxiliary::{
        loss::{AuxiliaryLoss, LossInputs, MenuItem, Passes, WeightedLoss},
        settings::AuxiliarySettings,
    },
};
use driml_model::{LossLayer, ModelConfig};
use serde::Deserialize;

/// The menu entry of the loss: `learner.update.auxiliary_loss = "prediction"`, one later state per row, and one column `prediction` in
/// `metrics.csv`.
pub(crate) static PREDICTION: MenuItem = MenuItem {
    name: NAME,
    positives: Positives::One,
    loss_names: &[NAME],
    make,
};

/// The name of the loss, and of its layer.
const NAME: &str = "prediction";

/// The settings of the loss, in the table `[learner.update.prediction]`.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct PredictionSettings {
    /// Weight of the loss in the total, above 0.
    weight: f64,
}

fn make(settings: &AuxiliarySettings<'_>) -> Result<Box<dyn AuxiliaryLoss>, UpdateError> {
    match settings.own_table()? {
        Some(PredictionSettings { weight }) if weight > 0.0 && weight.is_finite() => {
            Ok(Box::new(Prediction { weight }))
        }
        _ => Err(UpdateError::AuxiliaryLoss(
            "auxiliary_loss = prediction needs a weight above 0: --set learner.update.prediction.weight=0.01".into(),
        )),
    }
}

#[derive(Debug)]
struct Prediction {
    weight: f64,
}

impl AuxiliaryLoss for Prediction {
    /// Returns the one layer, from the features of s_t to those of s_{t+1}.
    fn layers(&self, model: &ModelConfig) -> Vec<LossLayer> {
        vec![LossLayer {
            name: NAME.to_owned(),
            inputs: model.hidden,
            outputs: model.hidden,
        }]
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

    /// Returns the mean over the rows with a next state of |W f4(s_t) + b - f4(s_{t+1})|^2 / D, D the width of f4; 0 if no row has one.
    fn losses(&self, inputs: &LossInputs<'_>) -> Result<Vec<WeightedLoss>, UpdateError> {
        let Some(later) = &inputs.features.later else {
            return Ok(Vec::new());
        };
        let now = &inputs.features.anchors.f4;
        let predicted = inputs.online.loss_layer(NAME, now)?;
        let valid = inputs.batch.positive_valid;
        let rows = valid.iter().filter(|&&valid| valid != 0).count().max(1);
        let weight = |&valid: &u8| f32::from(u8::from(valid != 0)) / rows as f32;
        let weights: Vec<f32> = valid.iter().map(weight).collect();
        let weights = Tensor::from_vec(weights, valid.len(), now.device())?;
        let errors = (predicted - later.f4.detach())?.sqr()?.mean(D::Minus1)?;
        let loss = (errors.to_dtype(DType::F32)? * weights)?.sum_all()?;
        Ok(vec![WeightedLoss {
            name: NAME,
            weight: self.weight,
            loss,
            dot_products: Vec::new(),
        }])
    }
}
