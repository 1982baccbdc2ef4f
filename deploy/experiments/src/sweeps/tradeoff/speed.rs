//! How fast a level learns and acts beside its dial's base, both alone in this process and in turns, so that a machine with other work
//! on it slows both alike. What whole runs do is in their summaries.

use driml_learner::{Agent, Compute};
use driml_machine::effort::{Effort, Work};
use driml_model::PolicyNetwork;
use driml_settings::config::RunConfig;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use super::{fixed_batch, results::Measured};

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
pub(super) fn measure(
    base: &RunConfig,
    level: &RunConfig,
    smoke: bool,
) -> anyhow::Result<Measured> {
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
