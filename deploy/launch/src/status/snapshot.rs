//! What a run says of itself when it is asked: one answer of all parts that can be asked.

use driml_protocol::{LearnerStatus, PartsStatus, ReplayStatus};
use serde::Serialize;

/// What a run says of itself.
#[derive(Clone, Debug, Serialize)]
pub struct Snapshot {
    /// The world.
    pub world: String,
    /// The agent.
    pub agent: String,
    /// Frames that are planned.
    pub frames_planned: u64,
    /// Updates that are planned.
    pub updates_planned: u64,
    /// Rows an update and a transition, as planned.
    pub replay_ratio_planned: f64,
    /// Actors that the settings name.
    pub actors_planned: u32,
    /// Frames a second, over the last while.
    pub frames_per_s: f64,
    /// Updates a second, over the last while.
    pub updates_per_s: f64,
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
}

impl Snapshot {
    /// All is learned and saved.
    pub fn is_over(&self) -> bool {
        self.replay.finished && self.learner.as_ref().is_some_and(|it| it.finished)
    }
}
