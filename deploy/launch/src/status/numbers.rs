//! The numbers of a run that is asked, under the names that they have in `metrics.csv`: for `--json` and for Prometheus.
//! It asks nobody and computes no more than means.

use std::{collections::BTreeMap, time::Duration};

use driml_protocol::{LearnerStatus, ReplayStatus};
use serde::Serialize;

/// How far a run is, how fast and how well; what is not known yet is none.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Numbers {
    /// Transitions that the replay servers have stored, all shards together.
    pub frames: u64,
    /// Updates that the learner has done; none while no learner answers.
    pub updates: Option<u64>,
    /// Frames a second, over the last while.
    pub frames_per_second: f64,
    /// Updates a second, over the last while.
    pub updates_per_second: f64,
    /// Rows sampled per transition, both counted from the end of the warm-up.
    pub replay_ratio: Option<f64>,
    /// Episodes that ended.
    pub episodes: u64,
    /// Mean undiscounted return of the newest episodes, 100 of each replay shard.
    pub mean_return: Option<f64>,
    /// Of how many episodes that is.
    pub mean_return_of: u64,
    /// C51's loss of the last update.
    pub c51_kl: Option<f64>,
    /// The auxiliary losses of the last update by name.
    pub losses: BTreeMap<String, f64>,
    /// The total loss of the last update.
    pub total_loss: Option<f64>,
    /// Norm of the last update's gradient, before clipping.
    pub grad_norm: Option<f64>,
    /// Mean Q value of the last update's states.
    pub q_mean: Option<f64>,
    /// Mean of k over the rows served.
    pub mean_k: Option<f64>,
    /// Its standard deviation.
    pub sd_k: Option<f64>,
    /// Mean age of the rows served last, in transitions.
    pub mean_age: f64,
    /// Version of the newest weights; none while no learner answers.
    pub weights_version: Option<u64>,
    /// Version of the affinity in use.
    pub affinity_version: u64,
    /// Actors that are connected.
    pub actors: u32,
    /// Who waits for whom at the rate limiter.
    pub waiting: String,
    /// Transitions that were produced and never arrived.
    pub transitions_lost: u64,
    /// Transitions stored twice.
    pub transitions_duplicated: u64,
    /// Messages refused.
    pub messages_refused: u64,
    /// All is learned and saved.
    pub finished: bool,
}

impl Numbers {
    /// Of what replay and learner answered, and how many frames and updates a second there were.
    pub(crate) fn of(
        replay: &ReplayStatus,
        learner: Option<&LearnerStatus>,
        (frames_per_second, updates_per_second): (f64, f64),
    ) -> Self {
        // Before the first update there are no losses.
        let learned = learner.filter(|it| it.updates > 0);
        let losses = learned.map_or(&[][..], |it| &it.losses);
        Self {
            frames: replay.transitions_inserted,
            updates: learner
                .map(|it| it.updates)
                .or_else(|| replay.learner_finished.then_some(replay.updates)),
            frames_per_second,
            updates_per_second,
            replay_ratio: replay.replay_ratio(),
            episodes: replay.episodes,
            mean_return: replay.returns.mean(),
            mean_return_of: replay.returns.newest.len() as u64,
            c51_kl: learned.map(|it| it.c51_kl.into()),
            losses: losses
                .iter()
                .map(|(name, loss)| (name.clone(), f64::from(*loss)))
                .collect(),
            total_loss: learned.map(|it| it.total.into()),
            grad_norm: learned.map(|it| it.grad_norm),
            q_mean: learned.map(|it| it.q_mean.into()),
            mean_k: replay.mean_k(),
            sd_k: replay.sd_k(),
            mean_age: replay.mean_age,
            weights_version: learner.map(|it| it.weights_version),
            affinity_version: replay.affinity_version,
            actors: replay.actors,
            waiting: replay.waiting.to_string(),
            transitions_lost: replay.transitions_lost,
            transitions_duplicated: replay.transitions_duplicated,
            messages_refused: replay.messages_refused,
            finished: replay.learner_finished
                || replay.finished && learner.is_some_and(|it| it.finished),
        }
    }
}

/// A time in seconds for a person.
pub(crate) fn seconds(seconds: f64) -> String {
    driml_machine::units::duration(Duration::try_from_secs_f64(seconds).unwrap_or_default())
}
