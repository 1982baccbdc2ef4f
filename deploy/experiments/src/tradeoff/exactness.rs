//! How exact a level's arithmetic is: losses, gradients and values of its own run's weights on held rows, against float64.
//! It says nothing of what is learned: a level may be exact and learn less.

use anyhow::Context;
use driml_launch::run_folder::RunFolder;
use driml_learner::{
    Agent, Compute, NetworkParameters, checkpoint,
    parity::{
        deviation::{ErrorOfUpdate, QError},
        float64::float64,
    },
};
use driml_model::PolicyNetwork;
use driml_settings::config::RunConfig;
use serde::{Deserialize, Serialize};

use super::held::HeldBatch;

/// Rows of a held batch: float64 takes seconds for them.
const ROWS_MAX: usize = 64;

/// Errors of a level against float64, at the weights of one of its runs.
#[derive(Clone, Copy, Debug, Serialize, Deserialize)]
pub(super) struct Exactness {
    /// Relative error of the total loss.
    pub(super) loss: f64,
    /// Relative error of the gradient, and 1 - cosine of its angle to the reference.
    pub(super) gradient: f64,
    pub(super) angle: f64,
    /// Of the learner's values of s_t, in units of return.
    pub(super) q_rms: f64,
    pub(super) q_max: f64,
    /// Share of rows with the reference's greedy action: by the learner, and by an actor with the weights as they are published.
    pub(super) same_learner: f64,
    pub(super) same_actor: f64,
    /// Of the actor's values of s_t.
    pub(super) actor_q_rms: f64,
}

/// Measures the newest checkpoint of a run of a level with `config`.
///
/// # Errors
/// A checkpoint that cannot be read, a world that cannot be had.
pub(super) fn measure(config: &RunConfig, folder: &RunFolder) -> anyhow::Result<Exactness> {
    let (model, update) = (&config.model, &config.learner.update);
    let compute = Compute::cpu(config.learner.precision);
    let restored = checkpoint::load_latest(
        &folder.checkpoints(),
        model,
        update,
        &Compute::CPU,
        config.run.hash(),
    )?;
    let restored = restored.with_context(|| format!("{} has no checkpoint", folder.display()))?;
    let parameters = NetworkParameters {
        online: restored.agent.online().copy()?,
        target: restored.agent.target().copy()?,
        key: None,
    };
    let agent = Agent::from_parameters(model.clone(), update.clone(), &compute, parameters)?;
    let weights = agent.weights()?;
    let rows = ROWS_MAX.min(config.learner.batch_size as usize);
    let held = HeldBatch::play(config, Some(&weights), rows)?;
    let reference = float64(&agent, &held.batch())?;
    let found = ErrorOfUpdate::of(&agent, &held.batch(), &reference)?;
    let published = agent.weights_as(config.learner.publish_as)?;
    let mut policy = PolicyNetwork::new(model, &published, config.actor.precision)?;
    let mut values = vec![0.0; rows * model.num_actions];
    policy.q_values(&held.states_t, &mut values)?;
    let acting = QError::of(&values, &reference.q_values_t, model.num_actions);
    Ok(Exactness {
        loss: found.loss,
        gradient: found.gradient,
        angle: found.angle,
        q_rms: found.q_rms,
        q_max: found.q_max,
        same_learner: found.same_action,
        same_actor: acting.same_action,
        actor_q_rms: acting.rms,
    })
}
