//! The acting loop: each step asks the policy for actions and steps all environments of a world.
//! It does not send, count or stop: callers record, deliver and limit the steps.

use driml_envs::{EnvError, Environment, FrameStack, StepEnd};
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

use crate::{error::ActError, policy::Policy};

/// One step of every environment.
#[derive(Debug)]
pub struct Step<'a> {
    /// Frames [N, frame bytes] in which the actions were taken, unstacked.
    pub frames: &'a [u8],
    /// The same frames stacked with the frames before them [N, state bytes], as the policy saw them.
    pub states: &'a [u8],
    /// Actions [N].
    pub actions: &'a [u8],
    /// Rewards [N] of the actions.
    pub rewards: &'a [f32],
    /// What each action ended, if anything [N].
    pub ends: &'a [StepEnd],
}

/// A running world, its frame stack, and the generator for exploration.
pub struct ActingLoop {
    world: Box<dyn Environment>,
    stack: FrameStack,
    rng: ChaCha8Rng,
    frames: Vec<u8>,
    actions: Vec<u8>,
    rewards: Vec<f32>,
    ends: Vec<StepEnd>,
    first: Vec<bool>,
}

/// The state of an [`ActingLoop`] between two steps.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ActingState {
    world: Vec<u8>,
    stacked: Vec<u8>,
    /// Whether each environment's next frame is the first of an episode or level [N].
    first: Vec<bool>,
    rng: ChaCha8Rng,
}

impl ActingLoop {
    /// Starts `world` with stacks of `frame_stack` frames; `rng` is for exploration alone.
    pub fn new(world: Box<dyn Environment>, frame_stack: usize, rng: ChaCha8Rng) -> Self {
        let (envs, shape) = (world.num_envs(), world.frame_shape());
        Self {
            stack: FrameStack::new(shape, frame_stack, envs),
            rng,
            frames: vec![0; envs * shape.bytes()],
            actions: vec![0; envs],
            rewards: vec![0.0; envs],
            ends: vec![StepEnd::Running; envs],
            first: vec![true; envs],
            world,
        }
    }

    /// Steps every environment once with an action from `policy`. After an error the world must not be stepped again.
    pub fn step(&mut self, policy: &mut dyn Policy, epsilon: f64) -> Result<Step<'_>, ActError> {
        self.world.observe(&mut self.frames);
        self.stack.push(&self.frames, &self.first);
        let states = self.stack.stacked();
        policy.act(states, epsilon, &mut self.rng, &mut self.actions)?;
        self.world
            .step(&self.actions, &mut self.rewards, &mut self.ends)?;
        for (first, end) in self.first.iter_mut().zip(&self.ends) {
            *first = *end != StepEnd::Running;
        }
        Ok(Step {
            frames: &self.frames,
            states,
            actions: &self.actions,
            rewards: &self.rewards,
            ends: &self.ends,
        })
    }

    /// Returns the state between two steps.
    pub fn state(&mut self) -> Result<ActingState, EnvError> {
        Ok(ActingState {
            world: self.world.save()?,
            stacked: self.stack.stacked().to_vec(),
            first: self.first.clone(),
            rng: self.rng.clone(),
        })
    }

    /// Restores a state saved with the same world.
    pub fn restore(&mut self, state: ActingState) -> Result<(), EnvError> {
        if state.first.len() != self.first.len() {
            let (found, own) = (state.first.len(), self.first.len());
            return Err(EnvError::State(format!("{found} environments, not {own}")));
        }
        self.world.load(&state.world)?;
        self.stack.load(&state.stacked)?;
        (self.first, self.rng) = (state.first, state.rng);
        Ok(())
    }
}
