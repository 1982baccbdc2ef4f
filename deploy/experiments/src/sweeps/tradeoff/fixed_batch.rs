//! Fixed batches, to measure the speed and the error of updates: rows of 512 steps of 16 environments, collected, stored and drawn as in
//! a run, but in this process. Frames, stacks, enlargement and k are those of the run. Nothing is augmented.

use anyhow::{anyhow, ensure};
use driml_actor::{ActorSettings, Collector, Incarnation};
use driml_learner::OwnedBatch;
use driml_protocol::{ActorJoin, BufferPool, InsertReply};
use driml_replay_server::{Config, Replay};
use driml_settings::config::RunConfig;

const ENVS: u32 = 16;
const CHUNKS: u32 = 8;
const CHUNK_STEPS: u32 = 64;
/// The seed of the world, the actions and the draws, so that all levels of a dial that does not change the world have the same rows.
const SEED: u64 = 1_000_003;

/// Plays the world of `config` with these weights, and returns `rows` rows. A share `epsilon` of the actions is random.
pub(super) fn sample(
    config: &RunConfig,
    weights: &[u8],
    epsilon: f64,
    rows: usize,
) -> anyhow::Result<OwnedBatch> {
    let mut settings = ActorSettings::from_toml(&config.to_toml())?;
    settings.spec.seed = SEED;
    let actor = &mut settings.actor;
    (actor.envs, actor.epsilon_ladder) = (ENVS, None);
    (actor.epsilon_start, actor.epsilon_end) = (epsilon, epsilon);
    let first = Incarnation::first(0, 1);
    let mut actor = Collector::new(&settings, BufferPool::new(1), first, 0, weights)?;
    let held = Config::unlimited((ENVS * CHUNKS * CHUNK_STEPS).into());
    let mut replay = Replay::new(&settings.spec, &held, config.learner.batch_size)?;
    let join = ActorJoin::new(first.actor, first.id);
    replay.join_actor(join).map_err(anyhow::Error::msg)?;
    for _ in 0..CHUNKS {
        let reply = replay.insert(&actor.collect(0, CHUNK_STEPS)?);
        ensure!(matches!(reply, InsertReply::Stored { .. }), "{reply:?}");
    }
    let drawn = replay.sample(rows as u32);
    let batch = drawn.map_err(|why| anyhow!("no batch: {why:?}"))?;
    let frame_size = settings.spec.frame_size();
    let resizer = config.input.resizer(frame_size, &config.model)?;
    let enlarged = |states: &[u8]| match &resizer {
        None => states.to_vec(),
        Some(resizer) => resizer.resized(states),
    };
    Ok(OwnedBatch {
        states_t: enlarged(&batch.states_t()),
        states_k: enlarged(&batch.states_k()),
        states_n: enlarged(&batch.states_n()),
        action: batch.actions().to_vec(),
        next_action: batch.next_actions().to_vec(),
        n_step_return: batch.n_step_returns(),
        bootstrap_discount: batch.bootstrap_discounts(),
        positive_valid: batch.positive_valid().to_vec(),
        ..OwnedBatch::default()
    })
}
