//! Everything that one update depends on beside the network's sizes: the table `[learner.update]`.
//! It fills in no number: presets do, with their sources.

use driml_model::DimParts;
use serde::{Deserialize, Serialize};

use crate::{
    auxiliary::{
        Auxiliary, Objective,
        cpc::Cpc,
        curl::{Curl, CurlSettings},
        dim::{Dim, Lambda},
    },
    error::UpdateError,
    optimiser::adam::AdamSettings,
};

/// Everything that one update depends on beside the network's sizes. No field has a default.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
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
    /// CURL's key encoder; there for that objective and for no other.
    pub curl: Option<CurlSettings>,
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
        self.objective
            .check(&self.lambda, self.condition_on_action, self.curl.as_ref())
            .map_err(UpdateError::Objective)?;
        if let Some(curl) = &self.curl {
            curl.validate()?;
        }
        self.adam.validate()
    }

    /// The auxiliary objective.
    pub fn auxiliary(&self) -> Auxiliary {
        let Self {
            lambda, tanh_clip, ..
        } = *self;
        let pairs = Dim { lambda, tanh_clip };
        match self.objective {
            Objective::None => Auxiliary::None,
            Objective::Dim => Auxiliary::Dim(pairs),
            Objective::Cpc => Auxiliary::Cpc(Cpc { pairs }),
            Objective::Curl => Auxiliary::Curl(Curl { tanh_clip }),
        }
    }

    /// The heads that the online network needs in a world of `num_actions` actions.
    pub fn dim_parts(&self, num_actions: usize) -> DimParts {
        let action = self.condition_on_action && num_actions > 1;
        self.objective.heads(&self.lambda, action)
    }
}
