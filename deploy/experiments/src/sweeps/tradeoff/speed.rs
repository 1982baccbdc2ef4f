//! How fast a level learns and acts beside its dial's base, both alone in this process and in turns, so that a machine with other work
//! on it slows both alike. What whole runs do is in their summaries.

use std::time::{Duration, Instant};

use driml_learner::{Agent, Compute, OwnedBatch};
use driml_model::PolicyNetwork;
use driml_settings::config::RunConfig;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

use super::fixed_batch;

/// Times of one update and one action, of a level and of its base in turns with it. Medians over the turns.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(super) struct Speed {
    /// Seconds of an update of all rows.
    pub(super) update_seconds: f64,
    /// How many times as many rows a second are learned from as at the base.
    rows_gain: f64,
    /// Seconds of choosing an action for one frame, among as many as an actor has environments.
    pub(super) act_seconds: f64,
    /// How many times as many frames a second are acted on as at the base.
    act_gain: f64,
    /// Of one broadcast of the weights.
    weights_bytes: u64,
    /// Of one frame as an actor sends it and the replay holds it, uncompressed.
    frame_bytes: u64,
}

/// What is timed.
struct Side {
    agent: Agent,
    held: OwnedBatch,
    policy: PolicyNetwork,
    /// Frames of a round of all environments of an actor.
    frames: Vec<u8>,
    actions: Vec<u8>,
}

impl Side {
    fn new(config: &RunConfig) -> anyhow::Result<Self> {
        let held = fixed_batch::play(config, None, config.learner.batch_size as usize)?;
        let agent = Agent::new(
            config.model.clone(),
            config.learner.update.clone(),
            &Compute::cpu(config.learner.precision),
            &mut ChaCha8Rng::seed_from_u64(1),
        )?
        .with_deduplication(config.learner.deduplicate_states);
        let weights = agent.weights_as(config.learner.publish_dtype)?;
        let policy = PolicyNetwork::new(&config.model, &weights, config.actor.precision)?;
        let envs = config.actor.envs as usize;
        let bytes = envs * config.model.frame_len();
        Ok(Self {
            frames: held.states_t.iter().copied().cycle().take(bytes).collect(),
            actions: vec![0; envs],
            agent,
            held,
            policy,
        })
    }

    /// Seconds of an update, and of an action for one frame; each over a turn.
    fn seconds(&mut self, turn: Duration) -> anyhow::Result<[f64; 2]> {
        let update = timed(turn, || {
            self.agent.update(&self.held.batch())?;
            Ok(())
        })?;
        let act = timed(turn, || {
            let acted = self.policy.greedy_actions(&self.frames, &mut self.actions);
            Ok(acted?)
        })?;
        Ok([update, act / self.actions.len() as f64])
    }
}

/// Mean seconds of a call, over a turn.
fn timed(turn: Duration, mut work: impl FnMut() -> anyhow::Result<()>) -> anyhow::Result<f64> {
    let started = Instant::now();
    let mut calls = 0;
    while calls == 0 || started.elapsed() < turn {
        work()?;
        calls += 1;
    }
    Ok(started.elapsed().as_secs_f64() / f64::from(calls))
}

/// Times `level` beside `base`: some seconds of both, a tenth of one for the smoke length.
pub(super) fn measure(base: &RunConfig, level: &RunConfig, smoke: bool) -> anyhow::Result<Speed> {
    // Turns of each side, an odd number, and how long a turn takes, at least; a turn has one call or more.
    let (rounds, turn) = if smoke { (1, 20) } else { (9, 80) };
    let turn = Duration::from_millis(turn);
    let (mut from, mut to) = (Side::new(base)?, Side::new(level)?);
    // Buffers are made in the first call.
    from.seconds(Duration::ZERO)?;
    to.seconds(Duration::ZERO)?;
    let [mut updates, mut update_gains, mut acts, mut act_gains] = [const { Vec::new() }; 4];
    for _ in 0..rounds {
        // In turns, a call of each after the other.
        let ([base_update, base_act], [update, act]) = (from.seconds(turn)?, to.seconds(turn)?);
        updates.push(update);
        update_gains.push(base_update / update);
        acts.push(act);
        act_gains.push(base_act / act);
    }
    let rows = to.held.action.len() as f64 / from.held.action.len() as f64;
    let run = &level.run;
    Ok(Speed {
        update_seconds: median(&mut updates),
        rows_gain: rows * median(&mut update_gains),
        act_seconds: median(&mut acts),
        act_gain: median(&mut act_gains),
        weights_bytes: to.agent.weights_as(level.learner.publish_dtype)?.len() as u64,
        frame_bytes: u64::from(run.frame_height * run.frame_width * run.frame_channels),
    })
}

/// The middle one of an odd number of values.
fn median(values: &mut [f64]) -> f64 {
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}
