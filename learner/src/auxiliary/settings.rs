//! The settings that auxiliary losses use: weights, the scores' clip, and a table of each loss's own settings.
//! The menu of losses is in `super`.

use driml_model::DimHeads;
use serde::{Deserialize, Serialize, de::DeserializeOwned};

use crate::{
    error::{Result, UpdateError},
    ranges::check_range,
};

/// The pairs NtM, in the order of every array of four here: features N of (s_t, a_t) are compared with features M of s_{t+k}.
pub const PAIRS: [&str; 4] = ["3t3", "3t4", "4t3", "4t4"];

/// Weight of each pair's loss in the total, 0 or above; a pair at 0 is not computed.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Lambda {
    /// Local features of (s_t, a_t) against local ones of s_{t+k}, at the same location.
    #[serde(rename = "3t3")]
    pub l3t3: f64,
    /// Local features of (s_t, a_t) against global ones of s_{t+k}.
    #[serde(rename = "3t4")]
    pub l3t4: f64,
    /// Global features of (s_t, a_t) against local ones of s_{t+k}.
    #[serde(rename = "4t3")]
    pub l4t3: f64,
    /// Global features of (s_t, a_t) against global ones of s_{t+k}.
    #[serde(rename = "4t4")]
    pub l4t4: f64,
}

impl Lambda {
    /// Every pair with a weight of 1.
    pub const ONES: Self = Self::from_values([1.0; 4]);

    /// No pair: every weight is 0.
    pub const NONE: Self = Self::from_values([0.0; 4]);

    /// Creates weights from values in the order of [`PAIRS`].
    pub const fn from_values([l3t3, l3t4, l4t3, l4t4]: [f64; 4]) -> Self {
        Self {
            l3t3,
            l3t4,
            l4t3,
            l4t4,
        }
    }

    /// The weights in the order of [`PAIRS`].
    pub const fn values(&self) -> [f64; 4] {
        [self.l3t3, self.l3t4, self.l4t3, self.l4t4]
    }

    /// The pairs with a weight above 0.
    pub fn active_pairs(&self) -> [bool; 4] {
        self.values().map(|lambda| lambda > 0.0)
    }

    /// The heads that the pairs with a weight above 0 need; `action` says whether psi is given a_t.
    pub fn dim_heads(&self, action: bool) -> DimHeads {
        Self::heads_for_pairs(self.active_pairs(), action)
    }

    /// The heads that the `active` pairs need.
    pub(super) fn heads_for_pairs(active: [bool; 4], action: bool) -> DimHeads {
        let [local_local, local_global, global_local, global_global] = active;
        let psi3 = local_local || local_global;
        let psi4 = global_local || global_global;
        DimHeads {
            psi3,
            phi3: local_local || global_local,
            psi4,
            phi4: local_global || global_global,
            action: action && (psi3 || psi4),
        }
    }

    /// Checks that every weight is from 0 to 1e30.
    pub fn validate(&self) -> Result<()> {
        for (name, value) in PAIRS.iter().zip(self.values()) {
            check_range(&format!("lambda.{name}"), value, 0.0..=1e30)?;
        }
        Ok(())
    }
}

/// The settings from which a loss is created.
#[derive(Clone, Copy, Debug)]
pub struct AuxiliarySettings<'a> {
    /// The loss's name in the menu.
    pub auxiliary_loss: &'static str,
    /// Weights of the losses between pairs of levels.
    pub lambda: Lambda,
    /// Whether Psi receives a_t.
    pub condition_on_action: bool,
    /// Bound c of the scores' soft clip `c * tanh(x / c)`.
    pub tanh_clip: f64,
    /// Tables of the losses' own settings, by the loss's name: `[learner.update.<name>]`.
    pub own: &'a toml::Table,
}

impl AuxiliarySettings<'_> {
    /// Reads the loss's own table; `None` if it is absent.
    pub fn own_table<T: DeserializeOwned>(&self) -> Result<Option<T>> {
        let Some(table) = self.own.get(self.auxiliary_loss) else {
            return Ok(None);
        };
        let own = table.clone().try_into();
        own.map(Some).map_err(|e| {
            let why = e.to_string();
            UpdateError::AuxiliaryLoss(format!("{}: {}", self.auxiliary_loss, why.trim_end()))
        })
    }

    /// Rejects a table for a loss that has no own settings.
    pub fn check_no_own_table(&self) -> Result<()> {
        let name = self.auxiliary_loss;
        if !self.own.contains_key(name) {
            return Ok(());
        }
        Err(UpdateError::AuxiliaryLoss(format!(
            "auxiliary_loss = {name} has no settings: take {name} out of learner.update"
        )))
    }

    /// Checks that at least one lambda is above 0, for a loss that lambda weights.
    pub fn check_any_pair_active(&self) -> Result<()> {
        if self.lambda.active_pairs().contains(&true) {
            return Ok(());
        }
        let name = self.auxiliary_loss;
        Err(UpdateError::AuxiliaryLoss(format!(
            "auxiliary_loss = {name}, but all lambdas are 0: set one above 0, or take the agent c51"
        )))
    }
}
