//! Everything that one update depends on beside the network's sizes: the table `[learner.update]`.
//! It fills in no number: presets do, with their sources.

use driml_model::DimParts;
use serde::{Deserialize, Deserializer, Serialize, de::Error};

use crate::{
    auxiliary::{
        Objective,
        loss::AuxiliaryLoss,
        settings::{AuxiliarySettings, Lambda},
    },
    error::UpdateError,
    optimiser::adam::AdamSettings,
};

/// Everything that one update depends on beside the network's sizes. No field has a default.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct LearnerSettings {
    /// Choose the action in s_{t+n} by the online network instead of the target network.
    pub double_dqn: bool,
    /// The auxiliary objective.
    pub objective: Objective,
    /// Whether Psi is given a_t, in a world where there is something to decide.
    pub condition_on_action: bool,
    /// Weights of the auxiliary losses, by pair of levels; all 0 for an agent without any.
    pub lambda: Lambda,
    /// Bound c of the auxiliary scores' soft clip `c * tanh(x / c)`, above 0.
    pub tanh_clip: f64,
    /// Global 2-norm to which gradients are clipped, above 0.
    pub max_grad_norm: f64,
    /// The optimiser's numbers.
    pub adam: AdamSettings,
    /// The target network moves once in so many updates, at least 1.
    pub target_period_updates: u64,
    /// Share of the online network in a move of the target network, in (0, 1].
    pub target_tau: f64,
    /// The objective's own numbers, a table of its name such as `[learner.update.curl]`; none for an objective that has none.
    #[serde(flatten, deserialize_with = "own_tables")]
    pub own: toml::Table,
}

/// What is left of the settings: nothing but tables of auxiliary losses.
fn own_tables<'de, D: Deserializer<'de>>(from: D) -> Result<toml::Table, D::Error> {
    let own = toml::Table::deserialize(from)?;
    let unknown = own.keys().find(|name| name.parse::<Objective>().is_err());
    match unknown {
        Some(name) => Err(D::Error::custom(format!("unknown field `{name}`"))),
        None => Ok(own),
    }
}

impl LearnerSettings {
    /// Checks the ranges.
    ///
    /// # Errors
    /// The first setting out of its range, with its value.
    pub fn validate(&self) -> Result<(), UpdateError> {
        let above_0 = |x: f64| x > 0.0 && x.is_finite();
        for (name, value, fine) in [
            ("tanh_clip", self.tanh_clip, above_0(self.tanh_clip)),
            (
                "max_grad_norm",
                self.max_grad_norm,
                above_0(self.max_grad_norm),
            ),
            (
                "target_tau",
                self.target_tau,
                above_0(self.target_tau) && self.target_tau <= 1.0,
            ),
            ("target_period_updates", 0.0, self.target_period_updates > 0),
        ] {
            if !fine {
                return Err(UpdateError::Settings(format!("{name} = {value}")));
            }
        }
        self.lambda.validate()?;
        self.auxiliary()?;
        self.adam.validate()
    }

    /// What the auxiliary loss is made from.
    pub const fn auxiliary_settings(&self) -> AuxiliarySettings<'_> {
        AuxiliarySettings {
            objective: self.objective.name(),
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
        self.objective.loss(&self.auxiliary_settings())
    }

    /// The heads that the online network needs in a world of `num_actions` actions; none where the settings cannot work, which
    /// [`LearnerSettings::validate`] says.
    pub fn dim_parts(&self, num_actions: usize) -> DimParts {
        let action = self.condition_on_action && num_actions > 1;
        let loss = self.auxiliary();
        loss.map_or(DimParts::NONE, |loss| loss.heads(action))
    }
}
