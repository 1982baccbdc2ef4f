//! What a run says of itself when it is asked: one answer of all parts that can be asked.

use driml_protocol::{LearnerStatus, PartsStatus, ReplayStatus};
use serde::Serialize;

use super::numbers::Numbers;

/// What a run says of itself.
#[derive(Clone, Debug, Serialize)]
pub struct Snapshot {
    /// The world.
    pub world: String,
    /// The agent.
    pub agent: String,
    /// The seed of every generator of the run.
    pub seed: u64,
    /// What all parts of the run agree on, as a hash: the same number is the same run.
    pub run_spec: String,
    /// Nothing is missing.
    pub well: bool,
    /// How far it is, how fast and how well, under the names of `metrics.csv`.
    #[serde(flatten)]
    pub numbers: Numbers,
    /// Frames that are planned.
    pub frames_planned: u64,
    /// Updates that are planned.
    pub updates_planned: u64,
    /// Rows an update and a transition, as planned.
    pub replay_ratio_planned: f64,
    /// Actors that the settings name.
    pub actors_planned: u32,
    /// Each replay server's answer.
    pub servers: Vec<ServerAnswer>,
    /// All replay servers' counts, as of one.
    pub replay: ReplayStatus,
    /// The learner's answer; none if it gave none.
    pub learner: Option<LearnerStatus>,
    /// Who waits for whom and since when, in sentences.
    pub waits: Vec<String>,
    /// What it would take to go on, in sentences; empty if nothing is missing.
    pub to_go_on: Vec<String>,
}

/// What one replay server says.
#[derive(Clone, Debug, Serialize)]
pub struct ServerAnswer {
    /// Where it was asked.
    pub endpoint: String,
    /// Its counts; none if it does not answer.
    pub replay: Option<ReplayStatus>,
    /// Who takes part; none if it does not answer.
    pub parts: Option<PartsStatus>,
    /// Why there is no answer.
    pub error: Option<String>,
    /// It answers, and for a run with other settings.
    pub is_another_run: bool,
}

impl Snapshot {
    /// All is learned and saved.
    pub fn is_over(&self) -> bool {
        self.numbers.finished
    }
}
