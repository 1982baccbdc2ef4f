//! How exact a level's arithmetic is: losses, gradients and values with its run's weights on fixed rows, against f32 by candle's own
//! operations.
//! It says nothing of what is learned: a level may be exact and learn less.

use anyhow::Context;
use driml_launch::run_folder::RunFolder;
use driml_learner::{
    Agent, Compute, NetworkParameters, checkpoint,
    parity::deviation::{ErrorOfUpdate, QError, REFERENCE},
};
use driml_model::PolicyNetwork;
use driml_settings::config::RunConfig;

use super::{fixed_batch, results::Measured};

/// Rows of the batch whose loss and gradient are compared, at most.
const ROWS_MAX: usize = 64;
/// States whose values and greedy actions are compared, for each of these rows.
const STATES_A_ROW: usize = 16;

/// Rows whose loss and gradient are compared, and states whose values and greedy actions are.
pub(super) fn sizes(config: &RunConfig) -> (usize, usize) {
    let rows = ROWS_MAX.min(config.learner.batch_size as usize);
    (rows, rows * STATES_A_ROW)
}

/// Measures the newest checkpoint of a run of a level with `config`.
pub(super) fn measure(config: &RunConfig, folder: &RunFolder) -> anyhow::Result<Measured> {
    let (model, update) = (&config.model, &config.learner.update);
    let compute = Compute::cpu(config.learner.precision);
    let (checkpoints, hash) = (folder.checkpoints(), config.run.hash());
    let restored = checkpoint::load_latest(&checkpoints, model, update, &REFERENCE, hash)?;
    let restored = restored.with_context(|| format!("{} has no checkpoint", folder.display()))?;
    let reference = restored.agent;
    let parameters = NetworkParameters {
        online: reference.online().copy()?,
        target: reference.target().copy()?,
        key: None,
    };
    let agent = Agent::from_parameters(model.clone(), update.clone(), &compute, parameters)?
        .with_deduplication(config.learner.deduplicate_states);
    let weights = agent.weights()?;
    let (rows, states) = sizes(config);
    let held = fixed_batch::play(config, Some(&weights), rows)?;
    let found = ErrorOfUpdate::of(&agent, &held.batch(), &reference)?;
    let published = agent.weights_as(config.learner.publish_dtype)?;
    let mut policy = PolicyNetwork::new(model, &published, config.actor.precision)?;
    let held = fixed_batch::play(config, Some(&weights), states)?;
    let mut acted = vec![0.0; held.action.len() * model.num_actions];
    policy.q_values(&held.states_t, &mut acted)?;
    let expected = reference.q_values_t(&held.batch())?;
    let [learning, acting] = [agent.q_values_t(&held.batch())?, acted]
        .map(|values| QError::of(&values, &expected, model.num_actions));
    let errors = [
        // Relative: of the total loss, of the gradient, and 1 - cosine of its angle to the reference.
        ("loss_error", found.loss),
        ("gradient_error", found.gradient),
        ("gradient_angle", found.angle),
        // Of the learner's values, in units of return.
        ("q_rms_error", learning.rms),
        ("q_max_error", learning.max),
        // Share of states with the reference's greedy action: by the learner, and by an actor with the weights as they are published.
        ("same_action_learner", learning.same_action),
        ("same_action_actor", acting.same_action),
        // Of the actor's values.
        ("actor_q_rms_error", acting.rms),
    ];
    Ok(errors.map(|(name, it)| (name.to_owned(), it)).into())
}
