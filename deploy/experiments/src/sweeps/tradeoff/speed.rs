//! How fast a level learns and acts beside its dial's base, both alone in this process and in turns, so that a machine with other work
//! on it slows both alike. What whole runs do is in their summaries.

use driml_learner::{Agent, Compute, OwnedBatch};
use driml_machine::effort::{Effort, Work};
use driml_model::PolicyNetwork;
use driml_settings::config::RunConfig;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use super::{fixed_batch, results::Measured};

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
        let (model, update) = (config.model.clone(), config.learner.update.clone());
        let compute = Compute::cpu(config.learner.precision);
        let rng = &mut ChaCha8Rng::seed_from_u64(1);
        let agent = Agent::new(model, update, &compute, rng)?
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

    fn update(&mut self) -> Work<'_> {
        Box::new(|| {
            self.agent.update(&self.held.batch())?;
            Ok(())
        })
    }

    /// An action for every frame of the round.
    fn act(&mut self) -> Work<'_> {
        Box::new(|| {
            self.policy
                .greedy_actions(&self.frames, &mut self.actions)?;
            Ok(())
        })
    }
}

/// Times `level` beside `base`: some seconds of both, less for the smoke length.
pub(super) fn measure(
    base: &RunConfig,
    level: &RunConfig,
    smoke: bool,
) -> anyhow::Result<Measured> {
    let effort = Effort::new(smoke);
    let (mut from, mut to) = (Side::new(base)?, Side::new(level)?);
    let updates = effort.rates_in_turn(&mut [from.update(), to.update()])?;
    let acts = effort.rates_in_turn(&mut [from.act(), to.act()])?;
    let gain = |rates: &[f64], of: fn(&Side) -> usize| {
        rates[1] * of(&to) as f64 / (rates[0] * of(&from) as f64)
    };
    let run = &level.run;
    let frame_bytes = run.frame_height * run.frame_width * run.frame_channels;
    let weights = to.agent.weights_as(level.learner.publish_dtype)?;
    let measured = [
        // Of an update of all rows, and how many times as many rows a second are learned from as at the base.
        ("update_seconds", 1.0 / updates[1]),
        ("rows_gain", gain(&updates, |it| it.held.action.len())),
        // Of choosing an action for one frame, among as many as an actor has environments, and how many times as many frames a second are
        // acted on as at the base.
        ("act_seconds", 1.0 / (acts[1] * to.actions.len() as f64)),
        ("act_gain", gain(&acts, |it| it.actions.len())),
        // Of one broadcast of the weights, and of one frame as an actor sends it and the replay holds it, uncompressed.
        ("weights_bytes", weights.len() as f64),
        ("frame_bytes", f64::from(frame_bytes)),
    ];
    Ok(measured.map(|(name, it)| (name.to_owned(), it)).into())
}
