//! Plays whole episodes with a run's weights, and with a random policy for comparison.
//! This module trains nothing and changes nothing in the run folder.

use std::{ops::ControlFlow, path::Path};

use anyhow::Context;
use clap::ValueEnum;
use driml_actor::{Evaluation, NetworkPolicy, OnStep, Policy, RandomPolicy, Step, episode_returns};
use driml_envs::{RestrictedWorld, WorldConfig};
use driml_learner::{Compute, checkpoint, insight::Insight};
use driml_machine::error::{Usage, usage};
use driml_model::{Parameters, Precision, Resizer, WeightDtype, is_dim};
use driml_settings::config::RunConfig;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use crate::{
    checkpoint_choice::{CheckpointChoice, WeightsChoice, checkpoint_path, read_config},
    run_folder::RunFolder,
};

/// Default probability of a random action. Source: section 2 of the project's specification, after rlpyt.
pub const EPSILON: f64 = 0.001;
const ENVS_MAX: usize = 32;
/// Steps of each environment, per round of episodes, after which an evaluation fails. An Atari episode has up to 27,000 steps; a
/// Procgen episode whose levels follow one another has no bound.
const STEPS_PER_ROUND_MAX: u64 = 200_000;
/// The stream of the policy's random generator. A world with the same seed gives its environments streams that count from 0.
const POLICY_STREAM: u64 = u64::MAX;

/// Which levels to play.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Levels {
    /// Training levels, as in training: an episode may continue through several levels
    Train,
    /// Training levels, drawn at random, one per episode (Procgen)
    TrainSingle,
    /// Levels not trained on, one per episode (Procgen)
    Unseen,
}

/// The policy that chooses the actions.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PolicyKind {
    /// The run's network.
    Agent,
    /// A random policy, with the same probability for each action.
    Random,
}

/// A run's weights and its world, ready to play.
pub struct Player {
    /// The settings of the run that trained them.
    pub config: RunConfig,
    /// The trained network, with DIM's heads if they are known. It plays without them, with weights in the data type of the actors.
    pub(crate) network: Parameters,
    /// Updates of the weights.
    pub updates: u64,
    /// Whether the weights are an average over updates.
    pub is_averaged: bool,
    /// Probability of a random action.
    pub epsilon: f64,
}

impl Player {
    /// Loads a checkpoint from a run's folder.
    pub fn load(
        folder: &RunFolder,
        choice: CheckpointChoice,
        weights: WeightsChoice,
    ) -> anyhow::Result<Self> {
        let config = read_config(folder)?;
        Self::load_checkpoint(config, &checkpoint_path(folder, choice)?, weights)
    }

    pub(crate) fn load_checkpoint(
        config: RunConfig,
        checkpoint: &Path,
        weights: WeightsChoice,
    ) -> anyhow::Result<Self> {
        let (model, update) = (&config.model, &config.learner.update);
        let hash = config.run.hash();
        let mut agent = checkpoint::load(checkpoint, model, update, &Compute::CPU, hash)?.agent;
        let is_averaged = weights == WeightsChoice::Average && agent.copy_average_to_online()?;
        Ok(Self {
            network: agent.online().clone(),
            updates: agent.updates(),
            is_averaged,
            epsilon: EPSILON,
            config,
        })
    }

    /// The kind of the weights: "averaged" or "online".
    pub const fn weights_name(&self) -> &'static str {
        match self.is_averaged {
            true => "averaged",
            false => "online",
        }
    }

    /// The same player with f32 weights and arithmetic, whatever the actors of the run use.
    #[must_use]
    pub fn with_f32(mut self) -> Self {
        self.config.learner.publish_dtype = WeightDtype::F32;
        self.config.actor.precision = Precision::F32;
        self
    }

    /// Plays whole episodes on the given levels. Returns their returns. Once `is_over` returns true, the rest is not played.
    ///
    /// # Errors
    /// The world does not have these levels; the policy or the world failed, or episodes do not end.
    pub fn returns(
        &self,
        policy_kind: PolicyKind,
        levels: Levels,
        episodes: usize,
        seed: u64,
        is_over: impl Fn() -> bool,
    ) -> anyhow::Result<Vec<f64>> {
        let world = world_with_levels(&self.config.world, levels)?;
        self.play(policy_kind, &world, episodes, seed, &mut stop_when(is_over))
    }

    /// Plays whole episodes in `world`, which is the run's world, perhaps with other levels. Returns their returns. `watch` sees every
    /// step, and may end the play before all episodes are over.
    ///
    /// # Errors
    /// The policy or the world failed, or episodes do not end.
    pub fn play(
        &self,
        policy_kind: PolicyKind,
        world: &WorldConfig,
        episodes: usize,
        seed: u64,
        watch: OnStep<'_>,
    ) -> anyhow::Result<Vec<f64>> {
        let config = &self.config;
        let mut policy: Box<dyn Policy> = match policy_kind {
            PolicyKind::Agent => {
                let (enlarge, precision) = (self.enlarge()?, config.actor.precision);
                let dtype = config.learner.publish_dtype;
                let weights = self.network.to_safetensors_as(dtype, |it| !is_dim(it))?;
                let policy = NetworkPolicy::new(&config.model, enlarge, &weights, precision)?;
                Box::new(policy)
            }
            PolicyKind::Random => Box::new(random_policy(config)?),
        };
        let (policy, epsilon) = (policy.as_mut(), self.epsilon);
        play_episodes(config, policy, world, episodes, epsilon, seed, watch)
    }

    /// The number of environments that play `episodes` episodes: one each, up to `ENVS_MAX`.
    pub fn envs(episodes: usize) -> usize {
        episodes.min(ENVS_MAX)
    }

    /// What the network computes for the states that the policy sees.
    pub fn insight(&self) -> anyhow::Result<Insight> {
        let mut model = self.config.model.clone();
        if self.network.iter().count() < model.parameter_shapes().len() {
            model = model.without_dim();
        }
        let compute = Compute::cpu(self.config.actor.precision);
        let update = &self.config.learner.update;
        let insight = Insight::new(&model, update, &self.network, compute, self.enlarge()?);
        Ok(insight?)
    }

    fn enlarge(&self) -> anyhow::Result<Option<Resizer>> {
        let (config, size) = (&self.config, self.config.run.frame_size());
        Ok(config.input.resizer(size, &config.model)?)
    }
}

/// Plays whole episodes with a random policy in a run's world, on the training levels. Returns their returns. Needs no checkpoint. Once
/// `is_over` returns true, the rest is not played.
pub fn random_returns(
    config: &RunConfig,
    episodes: usize,
    seed: u64,
    is_over: impl Fn() -> bool,
) -> anyhow::Result<Vec<f64>> {
    let world = world_with_levels(&config.world, Levels::Train)?;
    let (policy, watch) = (&mut random_policy(config)?, &mut stop_when(is_over));
    play_episodes(config, policy, &world, episodes, EPSILON, seed, watch)
}

/// A watcher that ends the play once `is_over` returns true.
fn stop_when(is_over: impl Fn() -> bool) -> impl FnMut(&Step<'_>, &[f64]) -> ControlFlow<()> {
    move |_: &Step<'_>, _: &[f64]| match is_over() {
        true => ControlFlow::Break(()),
        false => ControlFlow::Continue(()),
    }
}

fn random_policy(config: &RunConfig) -> anyhow::Result<RandomPolicy> {
    Ok(RandomPolicy::new(u8::try_from(config.run.num_actions)?))
}

fn play_episodes(
    config: &RunConfig,
    policy: &mut dyn Policy,
    world: &WorldConfig,
    episodes: usize,
    epsilon: f64,
    seed: u64,
    watch: OnStep<'_>,
) -> anyhow::Result<Vec<f64>> {
    let envs = Player::envs(episodes);
    let evaluation = Evaluation {
        frame_stack: config.run.frame_stack as usize,
        epsilon,
        episodes,
        steps_max: episodes.div_ceil(envs) as u64 * STEPS_PER_ROUND_MAX,
    };
    let actions = world.actions(config.actor.actions);
    let size = config.run.frame_size();
    let world = RestrictedWorld::wrap(world.build(envs, seed, 0)?, actions, size)?;
    episode_returns(world, policy, evaluation, policy_rng(seed), watch)
        .with_context(|| format!("playing {}", config.run.world))
}

/// The generator of the policy's random actions. Its numbers differ from those of every environment, which has the same seed.
fn policy_rng(seed: u64) -> ChaCha8Rng {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    rng.set_stream(POLICY_STREAM);
    rng
}

/// The world with the given levels.
pub fn world_with_levels(world: &WorldConfig, levels: Levels) -> Result<WorldConfig, Usage> {
    let changed = match levels {
        Levels::Train => Ok(world.clone()),
        Levels::TrainSingle => world.with_single_levels(),
        Levels::Unseen => world.with_unseen_levels(),
    };
    changed.map_err(|e| usage!("{e}"))
}

#[cfg(test)]
mod tests {
    use rand::Rng;

    use super::*;
    use crate::testing::{play_returns, untrained_player};

    #[test]
    fn an_evaluation_explores_as_asked() {
        // Source: section 2 of the project's specification.
        assert_eq!(EPSILON, 0.001);
        let played_by = |agent, epsilon| {
            let mut player = untrained_player("chain", agent);
            player.epsilon = epsilon;
            play_returns(&player)
        };
        let at_random = played_by("c51", 1.0);
        assert_eq!(at_random, played_by("rainbow", 1.0), "whatever the network");
        assert_ne!(at_random, played_by("c51", 0.0));
    }

    #[test]
    fn exploration_and_the_world_do_not_share_random_numbers() {
        for seed in [0, 1, u64::MAX] {
            let first = policy_rng(seed).random::<u64>();
            // The streams of a world's environments: two for each.
            for stream in 0..2 * ENVS_MAX as u64 {
                let mut copy = ChaCha8Rng::seed_from_u64(seed);
                copy.set_stream(stream);
                assert_ne!(copy.random::<u64>(), first, "stream {stream}");
            }
        }
    }
}
