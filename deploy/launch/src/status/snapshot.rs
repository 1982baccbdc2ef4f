//! What a run says of itself when it is asked: one answer of all parts that can be asked.

use driml_protocol::{LearnerStatus, PartsStatus, RecoveryProgress, ReplayStatus, Waiting};
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
    /// Its counts; none if it does not answer, or not yet.
    pub replay: Option<ReplayStatus>,
    /// Who takes part; none if it does not answer, or not yet.
    pub parts: Option<PartsStatus>,
    /// How far it is with reading its replay back from disk, before which it can answer nothing else; none if it is not about that.
    pub recovering: Option<RecoveryProgress>,
    /// Why there is no answer.
    pub error: Option<String>,
    /// Nothing listens there any more: its process has ended.
    pub is_gone: bool,
    /// It answers, and for a run with other settings.
    pub is_another_run: bool,
}

impl Snapshot {
    /// Each replay server that reads its replay back from disk, and how far it is.
    pub(crate) fn recovering(&self) -> impl Iterator<Item = (&ServerAnswer, RecoveryProgress)> {
        let servers = self.servers.iter();
        servers.filter_map(|it| Some((it, it.recovering?)))
    }

    /// Whether all replay servers have told their counts.
    pub(crate) fn is_answered(&self) -> bool {
        self.servers.iter().all(|it| it.replay.is_some())
    }

    /// Whether all replay servers have ended; the counts are then those of their last answers.
    pub(crate) fn is_gone(&self) -> bool {
        self.servers.iter().all(|it| it.is_gone)
    }

    /// All is learned and saved, or its replay servers have ended after all was sampled.
    pub fn is_over(&self) -> bool {
        self.numbers.finished || self.is_gone() && self.replay.waiting == Waiting::Finished
    }
}
