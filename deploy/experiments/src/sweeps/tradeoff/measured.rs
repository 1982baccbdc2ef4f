//! Measures a level in this process. Speed: how fast it learns and acts, in turns with its dial's base, so that other load on the machine
//! slows both alike. Exactness: the errors with the weights of its run, against f32 with candle's own operations.
//! The speed and returns of whole runs are in their summaries: a level may be exact and still learn less.

use anyhow::Context;
use driml_launch::run_folder::RunFolder;
use driml_learner::{
    Agent, Compute, NetworkParameters, checkpoint,
    parity::deviation::{QDeviation, REFERENCE, UpdateDeviation},
};
use driml_machine::speed_meter::{SpeedMeter, Work};
use driml_model::{PolicyNetwork, WeightDtype};
use driml_settings::config::RunConfig;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use super::{fixed_batch, results::Numbers};

const ROWS_MAX: usize = 64;
/// The number of states for each of these rows whose values and greedy actions are compared.
const STATES_PER_ROW: usize = 16;
/// The share of random actions in the episodes from which they are drawn.
const EPSILON: f64 = 0.1;

struct TimedWork {
    update: Work<'static>,
    /// Choosing an action for one frame of each environment, as an actor does.
    act: Work<'static>,
    weights_bytes: usize,
}

fn timed_work(config: &RunConfig) -> anyhow::Result<TimedWork> {
    let (model, update) = (config.model.clone(), config.learner.update.clone());
    let compute = Compute::cpu(config.learner.precision);
    let rng = &mut ChaCha8Rng::seed_from_u64(1);
    let mut agent = Agent::new(model, update, &compute, rng)?
        .with_deduplication(config.learner.deduplicate_states);
    let weights = agent.weights(config.learner.publish_dtype)?;
    let mut policy = PolicyNetwork::new(&config.model, &weights, config.actor.precision)?;
    // All actions are random, so that the weights do not decide the rows.
    let fixed = fixed_batch::sample(config, &weights, 1.0, config.learner.batch_size as usize)?;
    let envs = config.actor.envs as usize;
    let frames = fixed.states_t.iter().copied().cycle();
    let frames: Vec<u8> = frames.take(envs * config.model.frame_len()).collect();
    let mut actions = vec![0; envs];
    Ok(TimedWork {
        weights_bytes: weights.len(),
        update: Box::new(move || {
            agent.update(&fixed.batch())?;
            Ok(())
        }),
        act: Box::new(move || Ok(policy.greedy_actions(&frames, &mut actions)?)),
    })
}

/// Times `level` and `base` in turns, for some seconds each, less in the smoke length.
pub(super) fn speeds(base: &RunConfig, level: &RunConfig, smoke: bool) -> anyhow::Result<Numbers> {
    let meter = SpeedMeter::new(smoke);
    let (from, to) = (timed_work(base)?, timed_work(level)?);
    let updates = meter.rates_in_turn(&mut [from.update, to.update])?;
    let acts = meter.rates_in_turn(&mut [from.act, to.act])?;
    let gain = |rates: &[f64], size: fn(&RunConfig) -> u32| {
        let [from, to] = [base, level].map(|it| f64::from(size(it)));
        rates[1] * to / (rates[0] * from)
    };
    let run = &level.run;
    let frame_bytes = run.frame_height * run.frame_width * run.frame_channels;
    let measured = [
        // The time of an update of the whole batch, and the rows learned per second as a multiple of the base's.
        ("update_seconds", 1.0 / updates[1]),
        ("rows_gain", gain(&updates, |it| it.learner.batch_size)),
        // The time of an action for one frame, in a batch of as many frames as an actor has environments, and the frames acted on per
        // second as a multiple of the base's.
        ("act_seconds", 1.0 / (acts[1] * f64::from(level.actor.envs))),
        ("act_gain", gain(&acts, |it| it.actor.envs)),
        // The size of one broadcast of the weights, and of one uncompressed frame as the actor sends it and the replay stores it.
        ("weights_bytes", to.weights_bytes as f64),
        ("frame_bytes", f64::from(frame_bytes)),
    ];
    Ok(measured.map(|(name, it)| (name.to_owned(), it)).into())
}

/// Returns the number of rows whose loss and gradient are compared, and of states whose values and greedy actions are compared.
pub(super) fn sizes(config: &RunConfig) -> (usize, usize) {
    let rows = ROWS_MAX.min(config.learner.batch_size as usize);
    (rows, rows * STATES_PER_ROW)
}

/// Returns the errors of loss, gradient and values on fixed rows, with the newest checkpoint of a run with `config`.
pub(super) fn errors(config: &RunConfig, folder: &RunFolder) -> anyhow::Result<Numbers> {
    let (model, update) = (&config.model, &config.learner.update);
    let compute = Compute::cpu(config.learner.precision);
    let (checkpoints, hash) = (folder.checkpoints(), config.run.hash());
    let restored = checkpoint::load_latest(&checkpoints, model, update, &REFERENCE, hash)?;
    let restored = restored.with_context(|| format!("{} has no checkpoint", folder.display()))?;
    let reference = restored.agent;
    let parameters = NetworkParameters {
        online: reference.online().clone(),
        target: reference.target().clone(),
        key_encoder: reference.key_encoder().cloned(),
    };
    let agent = Agent::from_parameters(model.clone(), update.clone(), &compute, parameters)?
        .with_deduplication(config.learner.deduplicate_states);
    let weights = agent.weights(WeightDtype::F32)?;
    let (rows, states) = sizes(config);
    let sample = |rows| fixed_batch::sample(config, &weights, EPSILON, rows);
    let fixed = sample(rows)?;
    let found = UpdateDeviation::new(&agent, &fixed.batch(), &reference)?;
    let published = agent.weights(config.learner.publish_dtype)?;
    let mut policy = PolicyNetwork::new(model, &published, config.actor.precision)?;
    let fixed = sample(states)?;
    let mut actor_values = vec![0.0; fixed.action.len() * model.num_actions];
    policy.q_values(&fixed.states_t, &mut actor_values)?;
    let expected = reference.q_values_t(&fixed.batch())?;
    let [learning, acting] = [agent.q_values_t(&fixed.batch())?, actor_values]
        .map(|values| QDeviation::new(&values, &expected, model.num_actions));
    let errors = [
        // The relative errors of the total loss and of the gradient, and 1 - cosine of the gradient's angle to the reference.
        ("loss_error", found.loss),
        ("gradient_error", found.gradient),
        ("gradient_angle", found.angle),
        // The errors of the learner's values, in units of return.
        ("q_rms_error", learning.rms),
        ("q_max_error", learning.max),
        // The share of states with the reference's greedy action: for the learner, and for an actor with the published weights.
        ("same_action_learner", learning.same_action),
        ("same_action_actor", acting.same_action),
        // The error of the actor's values.
        ("actor_q_rms_error", acting.rms),
    ];
    Ok(errors.map(|(name, it)| (name.to_owned(), it)).into())
}
