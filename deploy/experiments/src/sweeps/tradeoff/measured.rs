//! What is measured of a level in this process: how fast it learns and acts beside its dial's base, in turns, so that a machine with other
//! work on it slows both alike; and how exact its arithmetic is with its run's weights, against f32 by candle's own operations.
//! What whole runs do and earn is in their summaries: a level may be exact and learn less.

use anyhow::Context;
use driml_launch::run_folder::RunFolder;
use driml_learner::{
    Agent, Compute, NetworkParameters, checkpoint,
    parity::deviation::{ErrorOfUpdate, QError, REFERENCE},
};
use driml_machine::effort::{Effort, Work};
use driml_model::PolicyNetwork;
use driml_settings::config::RunConfig;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use super::{fixed_batch, results::Measured};

/// Rows of the batch whose loss and gradient are compared, at most.
const ROWS_MAX: usize = 64;
/// States whose values and greedy actions are compared, for each of these rows.
const STATES_A_ROW: usize = 16;

/// What is timed of a configuration.
struct Side {
    /// An update of so many rows.
    update: Work<'static>,
    rows: usize,
    /// An action for a frame of each of so many environments, as an actor has.
    act: Work<'static>,
    envs: usize,
    /// Of one broadcast.
    weights_bytes: usize,
}

fn side(config: &RunConfig) -> anyhow::Result<Side> {
    let held = fixed_batch::play(config, None, config.learner.batch_size as usize)?;
    let (model, update) = (config.model.clone(), config.learner.update.clone());
    let compute = Compute::cpu(config.learner.precision);
    let rng = &mut ChaCha8Rng::seed_from_u64(1);
    let mut agent = Agent::new(model, update, &compute, rng)?
        .with_deduplication(config.learner.deduplicate_states);
    let weights = agent.weights_as(config.learner.publish_dtype)?;
    let mut policy = PolicyNetwork::new(&config.model, &weights, config.actor.precision)?;
    let envs = config.actor.envs as usize;
    let frames = held.states_t.iter().copied().cycle();
    let frames: Vec<u8> = frames.take(envs * config.model.frame_len()).collect();
    let mut actions = vec![0; envs];
    Ok(Side {
        rows: held.action.len(),
        envs,
        weights_bytes: weights.len(),
        update: Box::new(move || {
            agent.update(&held.batch())?;
            Ok(())
        }),
        act: Box::new(move || Ok(policy.greedy_actions(&frames, &mut actions)?)),
    })
}

/// Times `level` beside `base`: some seconds of both, less for the smoke length.
pub(super) fn speeds(base: &RunConfig, level: &RunConfig, smoke: bool) -> anyhow::Result<Measured> {
    let effort = Effort::new(smoke);
    let (from, to) = (side(base)?, side(level)?);
    let updates = effort.rates_in_turn(&mut [from.update, to.update])?;
    let acts = effort.rates_in_turn(&mut [from.act, to.act])?;
    let gain =
        |rates: &[f64], from: usize, to: usize| rates[1] * to as f64 / (rates[0] * from as f64);
    let run = &level.run;
    let frame_bytes = run.frame_height * run.frame_width * run.frame_channels;
    let measured = [
        // Of an update of all rows, and how many times as many rows a second are learned from as at the base.
        ("update_seconds", 1.0 / updates[1]),
        ("rows_gain", gain(&updates, from.rows, to.rows)),
        // Of choosing an action for one frame, among as many as an actor has environments, and how many times as many frames a second are
        // acted on as at the base.
        ("act_seconds", 1.0 / (acts[1] * to.envs as f64)),
        ("act_gain", gain(&acts, from.envs, to.envs)),
        // Of one broadcast of the weights, and of one frame as an actor sends it and the replay holds it, uncompressed.
        ("weights_bytes", to.weights_bytes as f64),
        ("frame_bytes", f64::from(frame_bytes)),
    ];
    Ok(measured.map(|(name, it)| (name.to_owned(), it)).into())
}

/// Rows whose loss and gradient are compared, and states whose values and greedy actions are.
pub(super) fn sizes(config: &RunConfig) -> (usize, usize) {
    let rows = ROWS_MAX.min(config.learner.batch_size as usize);
    (rows, rows * STATES_A_ROW)
}

/// Errors of losses, gradients and values on fixed rows, with the newest checkpoint of a run with `config`.
pub(super) fn errors(config: &RunConfig, folder: &RunFolder) -> anyhow::Result<Measured> {
    let (model, update) = (&config.model, &config.learner.update);
    let compute = Compute::cpu(config.learner.precision);
    let (checkpoints, hash) = (folder.checkpoints(), config.run.hash());
    let restored = checkpoint::load_latest(&checkpoints, model, update, &REFERENCE, hash)?;
    let restored = restored.with_context(|| format!("{} has no checkpoint", folder.display()))?;
    let reference = restored.agent;
    let parameters = NetworkParameters {
        online: reference.online().clone(),
        target: reference.target().clone(),
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
