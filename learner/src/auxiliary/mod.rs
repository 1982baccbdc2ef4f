//! The menu of auxiliary objectives: what an agent learns beside the return.
//! An item makes losses from features; it neither weighs them against C51 nor takes a step.

pub mod cpc;
pub mod curl;
pub mod dim;

use cpc::Cpc;
use curl::{Curl, CurlSettings};
use dim::{Dim, Lambda, PAIRS};
use driml_model::DimParts;
use serde::{Deserialize, Serialize};

/// The name of an auxiliary objective, as settings have it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Objective {
    /// The return alone.
    None,
    /// Deep InfoMax: one later state a row.
    Dim,
    /// Contrastive predictive coding: several later states a row.
    Cpc,
    /// Two views of the same state.
    Curl,
}

impl Objective {
    /// The name.
    pub const fn name(self) -> &'static str {
        match self {
            Self::None => "none",
            Self::Dim => "dim",
            Self::Cpc => "cpc",
            Self::Curl => "curl",
        }
    }

    /// Checks the settings that only make sense together.
    ///
    /// # Errors
    /// What is at odds, and what to do.
    pub fn check(
        self,
        lambda: &Lambda,
        condition_on_action: bool,
        curl: Option<&CurlSettings>,
    ) -> Result<(), String> {
        let name = self.name();
        let wanted = lambda.wanted();
        let weighted = PAIRS.iter().zip(wanted).find(|(_, wanted)| *wanted);
        match (self, weighted) {
            (Self::None, Some((pair, _))) => Err(format!(
                "objective = {name} computes no auxiliary loss, but lambda.{pair} is above 0: set it to 0, or take another agent"
            )),
            (Self::Dim | Self::Cpc | Self::Curl, None) => Err(format!(
                "objective = {name}, but all lambdas are 0: set one above 0, or take the agent c51"
            )),
            (Self::Curl, _) if wanted != [false, false, false, true] => Err(format!(
                "objective = {name} compares whole states, so lambda.4t4 alone may be above 0"
            )),
            (Self::Curl, _) if condition_on_action => Err(format!(
                "objective = {name} compares views of one state, which no action parts: set condition_on_action to false"
            )),
            (Self::Curl, _) if curl.is_none() => Err(format!(
                "objective = {name} encodes its keys by a moving average of the network, whose pace is missing (earlier versions had none): take the agent curl, or --set learner.update.curl.key_tau=0.001"
            )),
            (Self::None | Self::Dim | Self::Cpc, _) if curl.is_some() => Err(format!(
                "objective = {name} has no keys to encode: take the table curl out of learner.update, or take the agent curl"
            )),
            _ => Ok(()),
        }
    }

    /// The heads that the online network needs; `action` says whether Psi is given a_t.
    pub fn heads(self, lambda: &Lambda, action: bool) -> DimParts {
        match self {
            Self::None => DimParts::NONE,
            Self::Dim | Self::Cpc => lambda.dim_parts(action),
            Self::Curl => curl::HEADS,
        }
    }

    /// Later states a row that the replay server may serve: the least and the most.
    pub const fn served(self) -> (usize, usize) {
        match self {
            Self::None | Self::Curl => (0, 0),
            Self::Dim => (1, 1),
            Self::Cpc => (1, usize::MAX),
        }
    }
}

/// The auxiliary objective of an agent.
#[derive(Clone, Debug, PartialEq)]
pub enum Auxiliary {
    /// The agent learns the return alone: no second pass, no heads.
    None,
    /// Deep InfoMax between s_t and s_{t+k}.
    Dim(Dim),
    /// Contrastive predictive coding between s_t and s_{t+1}, .., s_{t+P}.
    Cpc(Cpc),
    /// Two views of s_t.
    Curl(Curl),
}
