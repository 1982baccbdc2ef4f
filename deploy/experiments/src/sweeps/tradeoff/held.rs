//! Held batches: rows of a world that no replay serves, on which the speed and the error of updates are measured.
//! They are spread over 512 steps of 16 copies, so over whole episodes. Frames, stacks and enlargement are the run's own; k is 1, and
//! nothing is augmented.

use anyhow::Context;
use driml_envs::{CutFrames, FewerActions, FrameStack, StepEnd};
use driml_learner::Batch;
use driml_model::PolicyNetwork;
use driml_protocol::NO_ACTION;
use driml_settings::config::RunConfig;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// Copies of the world that are played.
const COPIES: usize = 16;
/// Steps over which the rows of a copy are spread evenly.
const SPAN: usize = 512;
/// Share of random actions where a network chooses the others.
const EPSILON: f64 = 0.1;
/// Seed of the world and the actions: the same rows for every level of a dial that leaves the world alone.
const SEED: u64 = 1_000_003;

/// Rows as an update reads them.
#[derive(Default)]
pub(super) struct HeldBatch {
    pub(super) states_t: Vec<u8>,
    states_k: Vec<u8>,
    states_n: Vec<u8>,
    action: Vec<u8>,
    next_action: Vec<u8>,
    n_step_return: Vec<f32>,
    bootstrap_discount: Vec<f32>,
    positive_valid: Vec<u8>,
    positives: usize,
}

/// What all copies saw and did at one step.
struct Moment {
    /// [N, H, W, C] at the network's size; empty where no row has them.
    states: Vec<u8>,
    actions: Vec<u8>,
    rewards: Vec<f32>,
    ends: Vec<StepEnd>,
}

impl HeldBatch {
    /// Plays the world of `config` for `rows` rows, greedily with `weights` but for one action in ten, else at random.
    pub(super) fn play(
        config: &RunConfig,
        weights: Option<&[u8]>,
        rows: usize,
    ) -> anyhow::Result<Self> {
        let (n, k) = (config.run.n_step as usize, 1);
        let of_copy = rows.div_ceil(COPIES);
        let apart = SPAN.div_ceil(of_copy);
        let steps = of_copy * apart + n.max(k);
        let wanted_at = |step: usize| {
            let of_row = |offset: usize| step.checked_sub(offset).is_some_and(|t| t % apart == 0);
            [0, k, n].into_iter().any(of_row)
        };
        let history = history(config, weights, steps + 1, wanted_at)?;
        let len = config.model.frame_len();
        let wanted = usize::from(config.run.horizon.positives() > 0);
        let mut batch = Self {
            positives: wanted,
            ..Self::default()
        };
        for row in 0..rows {
            let (env, t) = (row % COPIES, row / COPIES * apart);
            let state = |t: usize| &history[t].states[env * len..][..len];
            let mut n_step_return = 0.0;
            let mut discount = 1.0;
            for moment in &history[t..t + n] {
                n_step_return += discount * f64::from(moment.rewards[env]);
                discount *= config.run.gamma;
                if ends(moment.ends[env]) {
                    discount = 0.0;
                    break;
                }
            }
            batch.states_t.extend_from_slice(state(t));
            batch.states_n.extend_from_slice(state(t + n));
            batch.action.push(history[t].actions[env]);
            batch.next_action.push(match ends(history[t].ends[env]) {
                true => NO_ACTION,
                false => history[t + 1].actions[env],
            });
            batch.n_step_return.push(n_step_return as f32);
            batch.bootstrap_discount.push(discount as f32);
            if wanted > 0 {
                batch.states_k.extend_from_slice(state(t + k));
                let is_running = history[t].ends[env] == StepEnd::Running;
                batch.positive_valid.push(u8::from(is_running));
            }
        }
        Ok(batch)
    }

    pub(super) fn batch(&self) -> Batch<'_> {
        Batch {
            rows: self.action.len(),
            states_t: &self.states_t,
            anchors: None,
            positives: self.positives,
            states_k: &self.states_k,
            states_n: &self.states_n,
            action: &self.action,
            next_action: &self.next_action,
            n_step_return: &self.n_step_return,
            bootstrap_discount: &self.bootstrap_discount,
            positive_valid: &self.positive_valid,
            importance_weight: None,
        }
    }

    pub(super) fn rows(&self) -> usize {
        self.action.len()
    }
}

/// Whether the return ends there.
fn ends(end: StepEnd) -> bool {
    matches!(end, StepEnd::TimedOut | StepEnd::Terminal)
}

/// `steps` steps of all copies, with the states of those that are `wanted_at`.
fn history(
    config: &RunConfig,
    weights: Option<&[u8]>,
    steps: usize,
    wanted_at: impl Fn(usize) -> bool,
) -> anyhow::Result<Vec<Moment>> {
    let mut rng = ChaCha8Rng::seed_from_u64(SEED);
    let actions = config.world.actions(config.actor.actions);
    let sent = [config.run.frame_height, config.run.frame_width].map(|side| side as usize);
    let sent = (sent[0], sent[1]);
    let world = config.world.build(COPIES, SEED, 0);
    let world = world.context("building the world")?;
    let mut world = CutFrames::of(FewerActions::of(world, actions)?, sent)?;
    let frame = world.frame_shape();
    let mut stack = FrameStack::new(frame, config.run.frame_stack as usize, COPIES)?;
    let model = &config.model;
    let enlarge = config.input.enlarge(sent, model)?;
    let mut policy = weights
        .map(|weights| PolicyNetwork::new(model, weights, config.actor.precision))
        .transpose()?;
    let mut frames = vec![0; frame.bytes() * COPIES];
    let mut first = vec![true; COPIES];
    let mut history = Vec::new();
    for step in 0..steps {
        world.observe(&mut frames);
        stack.push(&frames, &first);
        let mut moment = Moment {
            states: vec![0; model.frame_len() * COPIES],
            actions: vec![0; COPIES],
            rewards: vec![0.0; COPIES],
            ends: vec![StepEnd::Running; COPIES],
        };
        match &enlarge {
            Some(enlarge) => enlarge.apply(stack.stacked(), &mut moment.states),
            None => moment.states.copy_from_slice(stack.stacked()),
        }
        if let Some(policy) = &mut policy {
            policy.greedy_actions(&moment.states, &mut moment.actions)?;
        }
        for action in &mut moment.actions {
            if policy.is_none() || rng.random_bool(EPSILON) {
                *action = rng.random_range(0..model.num_actions) as u8;
            }
        }
        world.step(&moment.actions, &mut moment.rewards, &mut moment.ends)?;
        first = moment
            .ends
            .iter()
            .map(|end| *end != StepEnd::Running)
            .collect();
        if !wanted_at(step) {
            moment.states = Vec::new();
        }
        history.push(moment);
    }
    Ok(history)
}
