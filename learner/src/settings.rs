//! The table `[learner.update]`: all settings of an update except the network's sizes.
//! No number has a default here: presets give all of them, with their sources.

use std::ops::RangeInclusive;

use driml_model::DimHeads;
use serde::{Deserialize, Deserializer, Serialize, de::Error};

use crate::{
    auxiliary::{
        AuxiliaryKind,
        loss::AuxiliaryLoss,
        settings::{AuxiliarySettings, Lambda},
    },
    error::{Result, UpdateError},
    optimiser::adam::AdamSettings,
    ranges::{TAU_RANGE, check_range},
};

/// Range of the soft clip's bound: other devices than the CPU clip in f32, which must hold a score and its ratio to the bound.
const TANH_CLIP_RANGE: RangeInclusive<f64> = 1e-30..=1e30;
/// Below this range, the 1e-6 that clipping adds to the norm is too large. Above it, the square of a clipped gradient comes near
/// to the largest f32.
const MAX_GRAD_NORM_RANGE: RangeInclusive<f64> = 1e-6..=1e15;

/// All settings of an update except the network's sizes. Only `average_tau` and the auxiliary loss's own table may be absent.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct UpdateSettings {
    /// Whether the online network, instead of the target network, chooses the action in s_{t+n}.
    pub double_dqn: bool,
    /// The auxiliary loss.
    pub auxiliary_loss: AuxiliaryKind,
    /// Whether Psi receives a_t. Without effect in an environment with a single action.
    pub condition_on_action: bool,
    /// Weights of the auxiliary losses, by pair of levels; all 0 for an agent without an auxiliary loss.
    pub lambda: Lambda,
    /// Bound c of the auxiliary scores' soft clip `c * tanh(x / c)`, from 1e-30 to 1e30; the largest clips nothing.
    pub tanh_clip: f64,
    /// Global 2-norm to which gradients are clipped, from 1e-6 to 1e15; the largest in effect turns clipping off.
    pub max_grad_norm: f64,
    /// Adam's settings.
    pub adam: AdamSettings,
    /// Updates from one move of the target network to the next, at least 1.
    pub target_period_updates: u64,
    /// Share of the online network in a move of the target network, from 1e-5 to 1. Parameters are f32, so that the target stops moving
    /// within a relative distance of 6e-8 / tau from the online network: 6e-4 at 1e-4, and 6e-3 at 1e-5.
    pub target_tau: f64,
    /// Share of the online network in an update's move of the averaged network, from 1e-5 to 1; absent: no averaged network. In the first
    /// 1 / average_tau updates, the share of update t is 1 / t, which gives a plain mean. Checkpoints contain the averaged network, and
    /// `evaluate` plays it; training does not use it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub average_tau: Option<f64>,
    /// The auxiliary loss's own settings, in a table of its name such as `[learner.update.curl]`; empty if the loss has none.
    #[serde(flatten, deserialize_with = "deserialize_loss_tables")]
    pub own: toml::Table,
}

/// Reads the remaining keys, each of which must be the name of an auxiliary loss.
fn deserialize_loss_tables<'de, D: Deserializer<'de>>(from: D) -> Result<toml::Table, D::Error> {
    let own = toml::Table::deserialize(from)?;
    let mut names = own.keys();
    let unknown = names.find(|&name| AuxiliaryKind::try_from(name.clone()).is_err());
    match unknown {
        Some(name) => Err(D::Error::custom(format!("unknown field `{name}`"))),
        None => Ok(own),
    }
}

impl UpdateSettings {
    /// Checks the ranges.
    pub fn validate(&self) -> Result<()> {
        check_range("tanh_clip", self.tanh_clip, TANH_CLIP_RANGE)?;
        check_range("max_grad_norm", self.max_grad_norm, MAX_GRAD_NORM_RANGE)?;
        check_range("target_tau", self.target_tau, TAU_RANGE)?;
        if let Some(tau) = self.average_tau {
            check_range("average_tau", tau, TAU_RANGE)?;
        }
        if self.target_period_updates == 0 {
            return Err(UpdateError::Settings(
                "target_period_updates = 0, which must be at least 1".into(),
            ));
        }
        self.lambda.validate()?;
        self.make_auxiliary_loss()?;
        self.adam.validate()
    }

    /// Creates the auxiliary loss.
    pub fn make_auxiliary_loss(&self) -> Result<Box<dyn AuxiliaryLoss>> {
        self.auxiliary_loss.make_loss(&AuxiliarySettings {
            auxiliary_loss: self.auxiliary_loss.name(),
            lambda: self.lambda,
            condition_on_action: self.condition_on_action,
            tanh_clip: self.tanh_clip,
            own: &self.own,
        })
    }

    /// The heads that the online network needs in an environment of `num_actions` actions; none if the settings are invalid, which
    /// [`UpdateSettings::validate`] reports.
    pub fn dim_heads(&self, num_actions: usize) -> DimHeads {
        let action = self.condition_on_action && num_actions > 1;
        let loss = self.make_auxiliary_loss();
        loss.map_or(DimHeads::NONE, |loss| loss.heads(action))
    }
}
