//! Everything that one update depends on beside the network's sizes: the table `[learner.update]`.
//! It fills in no number: presets do, with their sources.

use std::ops::RangeInclusive;

use driml_model::DimHeads;
use serde::{Deserialize, Deserializer, Serialize, de::Error};

use crate::{
    auxiliary::{
        AuxiliaryKind,
        loss::AuxiliaryLoss,
        settings::{AuxiliarySettings, Lambda},
    },
    error::UpdateError,
    optimiser::adam::AdamSettings,
    ranges::{TAU, check_range},
};

/// Bounds of the soft clip at which f32, in which other devices than the CPU clip, holds both a score and its share of the bound.
const TANH_CLIP: RangeInclusive<f64> = 1e-30..=1e30;
/// Below it what clipping adds to a norm against a division by 0 is no longer small; above it the square of a gradient that is
/// within it comes near to the largest f32.
const MAX_GRAD_NORM: RangeInclusive<f64> = 1e-6..=1e15;

/// Everything that one update depends on beside the network's sizes. No field has a default.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct UpdateSettings {
    /// Choose the action in s_{t+n} by the online network instead of the target network.
    pub double_dqn: bool,
    /// The auxiliary loss.
    pub auxiliary_loss: AuxiliaryKind,
    /// Whether Psi is given a_t, in a world where there is something to decide.
    pub condition_on_action: bool,
    /// Weights of the auxiliary losses, by pair of levels; all 0 for an agent without any.
    pub lambda: Lambda,
    /// Bound c of the auxiliary scores' soft clip `c * tanh(x / c)`, from 1e-30 to 1e30; the largest clips nothing.
    pub tanh_clip: f64,
    /// Global 2-norm to which gradients are clipped, from 1e-6 to 1e15; the largest clips nothing that Adam can square.
    pub max_grad_norm: f64,
    /// The optimiser's numbers.
    pub adam: AdamSettings,
    /// Updates from one move of the target network to the next, at least 1.
    pub target_period_updates: u64,
    /// Share of the online network in a move of the target network, from 1e-5 to 1. Parameters are f32, and a target stands
    /// still within a relative 6e-8 / tau of the online network: 6e-4 at 1e-4, and 6e-3 at the least.
    pub target_tau: f64,
    /// Share of the online network in an update's move of the averaged network, from 1e-5 to 1; without it there is none. In the first
    /// 1 / average_tau updates the share of update t is 1 / t, which makes a plain mean. The averaged network is saved in checkpoints
    /// and is what `evaluate` plays; training does not use it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub average_tau: Option<f64>,
    /// The auxiliary loss's own numbers, a table of its name such as `[learner.update.curl]`; none for an auxiliary loss that has none.
    #[serde(flatten, deserialize_with = "own_tables")]
    pub own: toml::Table,
}

/// What is left of the settings: nothing but tables of auxiliary losses.
fn own_tables<'de, D: Deserializer<'de>>(from: D) -> Result<toml::Table, D::Error> {
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
    pub fn validate(&self) -> Result<(), UpdateError> {
        check_range("tanh_clip", self.tanh_clip, TANH_CLIP)?;
        check_range("max_grad_norm", self.max_grad_norm, MAX_GRAD_NORM)?;
        check_range("target_tau", self.target_tau, TAU)?;
        if let Some(tau) = self.average_tau {
            check_range("average_tau", tau, TAU)?;
        }
        if self.target_period_updates == 0 {
            return Err(UpdateError::Settings("target_period_updates = 0".into()));
        }
        self.lambda.validate()?;
        self.auxiliary()?;
        self.adam.validate()
    }

    /// What the auxiliary loss is made from.
    pub const fn auxiliary_settings(&self) -> AuxiliarySettings<'_> {
        AuxiliarySettings {
            auxiliary_loss: self.auxiliary_loss.name(),
            lambda: self.lambda,
            condition_on_action: self.condition_on_action,
            tanh_clip: self.tanh_clip,
            own: &self.own,
        }
    }

    /// The auxiliary loss.
    ///
    /// # Errors
    /// Settings of it that cannot work.
    pub fn auxiliary(&self) -> Result<Box<dyn AuxiliaryLoss>, UpdateError> {
        self.auxiliary_loss.loss(&self.auxiliary_settings())
    }

    /// The heads that the online network needs in a world of `num_actions` actions; none where the settings cannot work, which
    /// [`UpdateSettings::validate`] says.
    pub fn dim_heads(&self, num_actions: usize) -> DimHeads {
        let action = self.condition_on_action && num_actions > 1;
        let loss = self.auxiliary();
        loss.map_or(DimHeads::NONE, |loss| loss.heads(action))
    }
}
