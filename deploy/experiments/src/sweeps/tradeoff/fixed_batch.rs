//! Fixed batches: rows sampled directly from a world, without a replay, to measure the speed and the error of updates.
//! The rows are spread over 512 steps of 16 environments, and so over whole episodes. Frames, stacks and enlargement are those of the
//! run. k is 1, and nothing is augmented.

use anyhow::Context;
use driml_actor::{ActingLoop, NetworkPolicy, Policy, RandomPolicy};
use driml_envs::{RestrictedWorld, StepEnd};
use driml_learner::OwnedBatch;
use driml_protocol::NO_ACTION;
use driml_settings::config::RunConfig;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

const ENVS: usize = 16;
/// The number of steps over which the rows of an environment are spread evenly.
const SPAN_STEPS: usize = 512;
/// The share of random actions if a network chooses the others.
const EPSILON: f64 = 0.1;
/// The seed of the world and the actions, so that all levels of a dial that does not change the world have the same rows.
const SEED: u64 = 1_000_003;

struct EnvStep {
    /// The states [N, H, W, C] at the size of the network's input; empty if no row needs them.
    states: Vec<u8>,
    actions: Vec<u8>,
    rewards: Vec<f32>,
    ends: Vec<StepEnd>,
}

/// Plays the world of `config` and returns `rows` rows. With `weights` nine actions in ten are greedy; without, all are random.
pub(super) fn sample(
    config: &RunConfig,
    weights: Option<&[u8]>,
    rows: usize,
) -> anyhow::Result<OwnedBatch> {
    let (n, k) = (config.run.n_step as usize, 1);
    let rows_per_env = rows.div_ceil(ENVS);
    let spacing = SPAN_STEPS.div_ceil(rows_per_env);
    let steps = rows_per_env * spacing + n.max(k);
    let is_needed = |step: usize| {
        let of_row = |offset: usize| step.checked_sub(offset).is_some_and(|t| t % spacing == 0);
        [0, k, n].into_iter().any(of_row)
    };
    let history = play_history(config, weights, steps + 1, is_needed)?;
    let len = config.model.frame_len();
    let mut batch = OwnedBatch::default();
    let has_positive = config.run.horizon.positives() > 0;
    for row in 0..rows {
        let (env, t) = (row % ENVS, row / ENVS * spacing);
        let state = |t: usize| &history[t].states[env * len..][..len];
        let mut n_step_return = 0.0;
        let mut discount = 1.0;
        for env_step in &history[t..t + n] {
            n_step_return += discount * f64::from(env_step.rewards[env]);
            discount *= config.run.gamma;
            if is_end(env_step.ends[env]) {
                discount = 0.0;
                break;
            }
        }
        batch.states_t.extend_from_slice(state(t));
        batch.states_n.extend_from_slice(state(t + n));
        batch.action.push(history[t].actions[env]);
        batch.next_action.push(match is_end(history[t].ends[env]) {
            true => NO_ACTION,
            false => history[t + 1].actions[env],
        });
        batch.n_step_return.push(n_step_return as f32);
        batch.bootstrap_discount.push(discount as f32);
        if has_positive {
            batch.states_k.extend_from_slice(state(t + k));
            let is_running = history[t].ends[env] == StepEnd::Running;
            batch.positive_valid.push(u8::from(is_running));
        }
    }
    Ok(batch)
}

fn is_end(end: StepEnd) -> bool {
    matches!(end, StepEnd::TimedOut | StepEnd::Terminal)
}

/// Plays `steps` steps of all environments. The states are kept for the steps at which they are `is_needed`.
fn play_history(
    config: &RunConfig,
    weights: Option<&[u8]>,
    steps: usize,
    is_needed: impl Fn(usize) -> bool,
) -> anyhow::Result<Vec<EnvStep>> {
    let (run, model) = (&config.run, &config.model);
    let frame_size = (run.frame_height as usize, run.frame_width as usize);
    let world = config.world.build(ENVS, SEED, 0);
    let world = world.context("building the world")?;
    let actions = config.world.actions(config.actor.actions);
    let world = RestrictedWorld::wrap(world, actions, frame_size)?;
    let rng = ChaCha8Rng::seed_from_u64(SEED);
    let mut acting = ActingLoop::new(world, run.frame_stack as usize, rng)?;
    let enlarge = || config.input.resizer(frame_size, model);
    let enlarged = enlarge()?;
    let precision = config.actor.precision;
    let mut policy: Box<dyn Policy> = match weights {
        Some(weights) => Box::new(NetworkPolicy::new(model, enlarge()?, weights, precision)?),
        None => Box::new(RandomPolicy::new(u8::try_from(model.num_actions)?)),
    };
    let mut history = Vec::new();
    for step in 0..steps {
        let step_result = acting.step(&mut *policy, EPSILON)?;
        let mut states = Vec::new();
        match &enlarged {
            _ if !is_needed(step) => {}
            None => states.extend_from_slice(step_result.states),
            Some(enlarge) => {
                states.resize(model.frame_len() * ENVS, 0);
                enlarge.apply(step_result.states, &mut states);
            }
        }
        history.push(EnvStep {
            states,
            actions: step_result.actions.to_vec(),
            rewards: step_result.rewards.to_vec(),
            ends: step_result.ends.to_vec(),
        });
    }
    Ok(history)
}
