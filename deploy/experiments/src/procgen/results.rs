//! Finished runs and how their agents play: everything that the page, the figures and the data are made from.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use super::grid::Settings;
use crate::runs::FinishedRun;

/// A finished run and how its agent plays.
pub(super) struct RunResult {
    pub(super) world: String,
    pub(super) agent: String,
    pub(super) seed: u32,
    pub(super) ran: FinishedRun,
    pub(super) played: Evaluation,
}

/// Returns of whole episodes.
#[derive(Debug, Serialize, Deserialize)]
pub(super) struct Evaluation {
    /// In the world as it was trained in.
    pub(super) trained: Vec<f64>,
    /// On the levels trained on, one an episode; none for a world without levels.
    pub(super) single: Option<Vec<f64>>,
    /// On unseen levels, one an episode; none for a world without levels.
    pub(super) unseen: Option<Vec<f64>>,
}

/// All there is to report.
pub(super) struct Results {
    pub(super) settings: Settings,
    pub(super) cells: Vec<RunResult>,
    /// The random policy, by world.
    pub(super) random: BTreeMap<String, Evaluation>,
    /// Runs that are missing.
    pub(super) missing: Vec<String>,
    pub(super) command: String,
    pub(super) smoke: bool,
}

impl Results {
    /// Runs whose k follows the affinity.
    pub(super) fn adaptive(&self) -> impl Iterator<Item = &RunResult> {
        self.cells.iter().filter(|cell| cell.agent == "driml-ada")
    }

    /// The runs of an agent in a world, by seed.
    pub(super) fn of<'a>(
        &'a self,
        world: &'a str,
        agent: &'a str,
    ) -> impl Iterator<Item = &'a RunResult> {
        let here = move |cell: &&RunResult| cell.world == world && cell.agent == agent;
        self.cells.iter().filter(here)
    }

    /// Mean returns of the played episodes, by seed.
    pub(super) fn means(&self, world: &str, agent: &str, kind: Kind) -> Vec<f64> {
        let cells = self.of(world, agent);
        cells.filter_map(|cell| cell.score(kind)).collect()
    }

    /// Worlds and agents that have a run.
    pub(super) fn worlds(&self) -> Vec<&str> {
        let has = |world: &&String| self.cells.iter().any(|cell| cell.world == **world);
        let worlds = self.settings.worlds.iter();
        worlds.filter(has).map(String::as_str).collect()
    }

    pub(super) fn agents(&self) -> Vec<&str> {
        let has = |agent: &&String| self.cells.iter().any(|cell| cell.agent == **agent);
        let agents = self.settings.agents.iter();
        agents.filter(has).map(String::as_str).collect()
    }
}

/// What a score is of.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Kind {
    /// The last 100 episodes of the training, as in table 1.
    Training,
    /// Greedy, in the world as it was trained in.
    Trained,
    /// Greedy, on the levels trained on, one an episode.
    Single,
    /// Greedy, on unseen levels, one an episode.
    Unseen,
}

impl Kind {
    pub(super) const ALL: [Self; 4] = [Self::Training, Self::Trained, Self::Single, Self::Unseen];

    /// As figures and data have it.
    pub(super) const fn name(self) -> &'static str {
        match self {
            Self::Training => "training",
            Self::Trained => "greedy",
            Self::Single => "levels trained on",
            Self::Unseen => "unseen levels",
        }
    }
}

impl RunResult {
    pub(super) fn score(&self, kind: Kind) -> Option<f64> {
        match kind {
            Kind::Training => self.ran.summary.mean_return,
            _ => self.played.mean(kind),
        }
    }
}

impl Evaluation {
    pub(super) fn mean(&self, kind: Kind) -> Option<f64> {
        let returns = match kind {
            Kind::Training => None,
            Kind::Trained => Some(&self.trained),
            Kind::Single => self.single.as_ref(),
            Kind::Unseen => self.unseen.as_ref(),
        }?;
        (!returns.is_empty()).then(|| returns.iter().sum::<f64>() / returns.len() as f64)
    }
}
