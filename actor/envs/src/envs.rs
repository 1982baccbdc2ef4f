//! The code that worlds share: a generator per environment, checks of the caller's buffers, and worlds stepped one environment at a time.
//! It holds no game rules.

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use serde::{Serialize, de::DeserializeOwned};

use crate::environment::{Environment, FrameShape, StepEnd, StepResult};
use crate::error::{EnvError, require};
use crate::saved;
use crate::settings::WorldSettings;

/// One environment of a world whose environments are stepped one by one.
pub trait SingleEnv: Send + Sized {
    /// The settings that all environments of a world share.
    type Config: WorldSettings + Clone + Send;

    /// The state of an environment that does not follow from the settings.
    type State: Serialize + DeserializeOwned;

    /// Creates environment number `env` of a world with this seed, at its first frame. The settings must be valid.
    fn new(config: &Self::Config, seed: u64, env: usize) -> Self;

    /// Writes the current frame [H, W, C].
    fn render(&self, config: &Self::Config, frame: &mut [u8]);

    /// Takes a valid action and returns its reward and end. Resets the environment if its episode ended.
    fn act(&mut self, config: &Self::Config, action: u8) -> (f32, StepEnd);

    /// Returns the state to save.
    fn state(&self) -> Self::State;

    /// Restores the state that another environment saved.
    fn restore(&mut self, config: &Self::Config, state: Self::State) -> Result<(), EnvError>;
}

/// A world of environments that are stepped one by one.
pub struct SerialWorld<E: SingleEnv> {
    config: E::Config,
    pub(crate) envs: Vec<E>,
}

impl<E: SingleEnv> SerialWorld<E> {
    /// Creates `num_envs` environments; environment i depends on (`seed`, i) and its actions only.
    ///
    /// # Errors
    /// Invalid settings, or `num_envs` = 0.
    pub fn new(config: &E::Config, num_envs: usize, seed: u64) -> Result<Self, EnvError> {
        config.validate()?;
        check_num_envs(num_envs)?;
        let envs = (0..num_envs).map(|env| E::new(config, seed, env));
        Ok(Self {
            envs: envs.collect(),
            config: config.clone(),
        })
    }
}

impl<E: SingleEnv> Environment for SerialWorld<E> {
    fn frame_shape(&self) -> FrameShape {
        self.config.frame_shape()
    }

    fn num_actions(&self) -> usize {
        self.config.action_names().len()
    }

    fn num_envs(&self) -> usize {
        self.envs.len()
    }

    fn observe(&mut self, frames: &mut [u8]) {
        let shape = self.frame_shape();
        check_frames(frames, self.num_envs(), shape);
        let frames = frames.chunks_exact_mut(shape.bytes());
        for (env, frame) in self.envs.iter().zip(frames) {
            env.render(&self.config, frame);
        }
    }

    fn step(&mut self, actions: &[u8], rewards: &mut [f32], ends: &mut [StepEnd]) -> StepResult {
        check_step(self.num_envs(), self.num_actions(), actions, rewards, ends)?;
        for (i, (env, &action)) in self.envs.iter_mut().zip(actions).enumerate() {
            (rewards[i], ends[i]) = env.act(&self.config, action);
        }
        Ok(())
    }

    fn save(&mut self) -> Result<Vec<u8>, EnvError> {
        let envs: Vec<_> = self.envs.iter().map(E::state).collect();
        saved::encode(&envs)
    }

    fn load(&mut self, state: &[u8]) -> Result<(), EnvError> {
        let states: Vec<E::State> = saved::decode(state)?;
        saved::check_env_count(states.len(), self.num_envs())?;
        let mut envs = self.envs.iter_mut().zip(states);
        envs.try_for_each(|(env, state)| env.restore(&self.config, state))
    }
}

/// Checks that the argument of `Environment::observe` is as long as the frames of all environments.
pub(crate) fn check_frames(frames: &[u8], num_envs: usize, shape: FrameShape) {
    assert_eq!(
        frames.len(),
        num_envs * shape.bytes(),
        "observe needs room for every environment's frame"
    );
}

/// The use of an environment's generator. Each use has its own stream, so that a new use does not change the others.
#[derive(Clone, Copy)]
pub(crate) enum RngUse {
    /// The game's own chance moves.
    Game,
    /// The Ising model in Ms. PacMan's walls.
    Overlay,
}

/// Returns the generator of environment `env` in a world seeded with `seed`: ChaCha8 keyed by the seed, one stream per environment and use.
pub(crate) fn env_rng(seed: u64, env: usize, rng_use: RngUse) -> ChaCha8Rng {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    rng.set_stream(2 * env as u64 + rng_use as u64);
    rng
}

pub(crate) fn check_num_envs(num_envs: usize) -> Result<(), EnvError> {
    let why = "a world needs at least one environment, got num_envs = 0";
    require(num_envs > 0, why)
}

/// Checks the arguments of `Environment::step`: `actions`, `rewards` and `ends` are [N], each action < `num_actions`.
pub(crate) fn check_step(
    num_envs: usize,
    num_actions: usize,
    actions: &[u8],
    rewards: &[f32],
    ends: &[StepEnd],
) -> Result<(), EnvError> {
    for (name, got) in [
        ("actions", actions.len()),
        ("rewards", rewards.len()),
        ("ends", ends.len()),
    ] {
        if got != num_envs {
            return Err(EnvError::Step(format!(
                "{name} has {got} entries, but the world has {num_envs} environments"
            )));
        }
    }
    let mut by_env = actions.iter().enumerate();
    match by_env.find(|(_, action)| usize::from(**action) >= num_actions) {
        Some((env, action)) => Err(EnvError::Step(format!(
            "action {action} of environment {env} is out of range: this world has {num_actions} actions"
        ))),
        None => Ok(()),
    }
}
