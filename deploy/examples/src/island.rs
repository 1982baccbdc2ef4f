//! A custom world: an island with a treasure on it, at another place in each episode.

use driml_envs::{
    BuildResult, EnvError, Environment, FrameShape, StepEnd, StepResult, WorldSettings,
};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde::Deserialize;

/// What each action adds to row and column.
const MOVES: [(isize, isize); 4] = [(-1, 0), (1, 0), (0, -1), (0, 1)];

/// The settings of an island, the table `[world]`.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct IslandConfig {
    /// The side of the island, in fields: 2 to 32.
    side: usize,
    /// Env steps after which an episode is cut off, at least 1.
    step_limit: u32,
    /// The reward of the treasure.
    reward: f32,
}

impl WorldSettings for IslandConfig {
    fn validate(&self) -> Result<(), EnvError> {
        if !(2..=32).contains(&self.side) || self.step_limit == 0 || !self.reward.is_finite() {
            return Err(EnvError::Config(format!(
                "an island has 2 to 32 fields a side, a step limit and a finite reward, got {self:?}"
            )));
        }
        Ok(())
    }

    fn frame_shape(&self) -> FrameShape {
        FrameShape::new(self.side, self.side, 1)
    }

    fn action_names(&self) -> Vec<&str> {
        vec!["up", "down", "left", "right"]
    }

    fn build(&self, num_envs: usize, seed: u64, _threads: usize) -> BuildResult {
        self.validate()?;
        let islands = (0..num_envs).map(|env| Island::new(seed, env, self.side));
        Ok(Box::new(Islands {
            config: self.clone(),
            islands: islands.collect(),
        }))
    }
}

/// One island: where its agent and its treasure are.
struct Island {
    rng: ChaCha8Rng,
    agent: (usize, usize),
    treasure: (usize, usize),
    steps: u32,
}

impl Island {
    /// Makes the island number `env`. It depends on the seed and this number alone, whatever the other islands are.
    fn new(seed: u64, env: usize, side: usize) -> Self {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        rng.set_stream(env as u64);
        let mut island = Self {
            rng,
            agent: (0, 0),
            treasure: (0, 0),
            steps: 0,
        };
        island.begin_episode(side);
        island
    }

    fn begin_episode(&mut self, side: usize) {
        let mut random_place = || {
            let (row, column) = (0..side, 0..side);
            (self.rng.random_range(row), self.rng.random_range(column))
        };
        (self.agent, self.treasure) = (random_place(), random_place());
        if self.agent == self.treasure {
            self.treasure.0 = (self.agent.0 + 1) % side;
        }
        self.steps = 0;
    }
}

struct Islands {
    config: IslandConfig,
    islands: Vec<Island>,
}

impl Environment for Islands {
    fn frame_shape(&self) -> FrameShape {
        self.config.frame_shape()
    }

    fn num_actions(&self) -> usize {
        MOVES.len()
    }

    fn num_envs(&self) -> usize {
        self.islands.len()
    }

    fn observe(&mut self, frames: &mut [u8]) {
        frames.fill(0);
        let side = self.config.side;
        for (frame, island) in frames.chunks_exact_mut(side * side).zip(&self.islands) {
            for ((row, column), shade) in [(island.treasure, 128), (island.agent, 255)] {
                frame[row * side + column] = shade;
            }
        }
    }

    fn step(&mut self, actions: &[u8], rewards: &mut [f32], ends: &mut [StepEnd]) -> StepResult {
        let config = &self.config;
        let last = config.side - 1;
        for (env, (island, &action)) in self.islands.iter_mut().zip(actions).enumerate() {
            let Some((down, right)) = MOVES.get(usize::from(action)) else {
                return Err(EnvError::Step(format!(
                    "action {action} of environment {env} is out of range: this world has {} actions",
                    MOVES.len()
                )));
            };
            let (row, column) = island.agent;
            island.agent = (
                row.saturating_add_signed(*down).min(last),
                column.saturating_add_signed(*right).min(last),
            );
            island.steps += 1;
            (rewards[env], ends[env]) = if island.agent == island.treasure {
                (config.reward, StepEnd::Terminal)
            } else if island.steps >= config.step_limit {
                (0.0, StepEnd::TimedOut)
            } else {
                (0.0, StepEnd::Running)
            };
            if ends[env] != StepEnd::Running {
                island.begin_episode(config.side);
            }
        }
        Ok(())
    }
}
