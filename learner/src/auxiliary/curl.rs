//! CURL: InfoNCE between two views of the same state, the second one encoded by a moving average of the network.
//! It makes no views: `augment` does.
//!
//! The query is psi_4(f4) of the online network, the key psi_4(f4) of the key encoder. No gradient reaches the key. The key
//! encoder is separate from C51's target network, which works alike for all agents and would move once in hundreds of updates.
//! Source: Srinivas et al. 2020 and He et al. 2020 for the two views and the momentum encoder; Mazoure et al. 2020, appendix:
//! "exactly the same networks for measuring similarity (i.e. one residual block for CURL and CPC)", hence no bilinear
//! product and no second head.

use driml_model::DimHeads;
use serde::{Deserialize, Serialize};

use super::{
    dim,
    loss::{AuxiliaryLoss, LossInputs, MenuItem, Passes, WeightedLoss},
    positives::Positives,
    settings::AuxiliarySettings,
};
use crate::{
    error::{Result, UpdateError},
    losses::info_nce::info_nce_loss,
    ranges::{TAU_RANGE, check_range},
};

/// The menu item of CURL.
pub const CURL: MenuItem = MenuItem {
    name: "curl",
    positives: Positives::OtherView,
    loss_names: &["curl"],
    make,
};

/// CURL's own table, `[learner.update.curl]`.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CurlSettings {
    /// Share of the online network in the key encoder's move after each update, from 1e-5 to 1. `target_tau` describes the limits of
    /// f32 for small values.
    pub key_tau: f64,
}

fn make(settings: &AuxiliarySettings<'_>) -> Result<Box<dyn AuxiliaryLoss>> {
    settings.check_any_pair_active()?;
    let said = |what: &str| format!("auxiliary_loss = curl {what}");
    let fault = |what: &str| Err(UpdateError::AuxiliaryLoss(said(what)));
    if settings.lambda.active_pairs() != [false, false, false, true] {
        return fault("compares whole states, so lambda.4t4 alone may be above 0");
    }
    if settings.condition_on_action {
        return fault(
            "compares views of one state, which no action parts: set condition_on_action to false",
        );
    }
    let Some(CurlSettings { key_tau }) = settings.own_table()? else {
        return fault(
            "encodes its keys by a moving average of the network, whose pace is missing (earlier versions had none): take the agent curl, or --set learner.update.curl.key_tau=0.001",
        );
    };
    check_range("curl.key_tau", key_tau, TAU_RANGE)?;
    Ok(Box::new(Curl {
        weight: settings.lambda.l4t4,
        tanh_clip: settings.tanh_clip,
        key_tau,
    }))
}

#[derive(Clone, Copy, Debug, PartialEq)]
struct Curl {
    weight: f64,
    tanh_clip: f64,
    key_tau: f64,
}

impl AuxiliaryLoss for Curl {
    /// One head, psi_4, of which the key encoder has a copy.
    fn heads(&self, _action: bool) -> DimHeads {
        DimHeads {
            psi4: true,
            ..DimHeads::NONE
        }
    }

    fn key_tau(&self) -> Option<f64> {
        Some(self.key_tau)
    }

    /// The query forward and backward, the key forward.
    fn passes(&self, _positives: usize, _augmented: bool) -> Passes {
        Passes {
            states: 1,
            keys: 1,
            psi: 1,
            global_scores: 1,
            ..Passes::default()
        }
    }

    /// Computes the InfoNCE of the online network's vectors of one view with the key encoder's vectors of the other view. All rows take
    /// part, as no later state is needed.
    fn losses(&self, inputs: &LossInputs<'_>) -> Result<Vec<WeightedLoss>> {
        let keys = inputs.key_vectors()?;
        let anchors = &inputs.features.anchors;
        let query = inputs.online.psi4(&anchors.f4, &inputs.action()?)?;
        let kernels = inputs.online.kernels();
        let dots = dim::dot(kernels, &query, &keys)?;
        let all = vec![1; inputs.batch.rows];
        let loss = info_nce_loss(&dots, &all, self.tanh_clip, kernels)?;
        Ok(vec![WeightedLoss {
            name: "curl",
            weight: self.weight,
            loss,
            dot_products: vec![dots],
        }])
    }
}
