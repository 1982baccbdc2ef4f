//! A custom world: an island with a treasure on it, at another place in each episode.

use driml_envs::{
    BuildResult, EnvError, FrameShape, SerialWorld, SingleEnv, StepEnd, WorldSettings,
};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

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
        Ok(Box::new(SerialWorld::<Island>::new(self, num_envs, seed)?))
    }
}

/// One island: where its agent and its treasure are. The saved state is this struct.
#[derive(Clone, Serialize, Deserialize)]
struct Island {
    rng: ChaCha8Rng,
    agent: (usize, usize),
    treasure: (usize, usize),
    steps: u32,
}

impl Island {
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

impl SingleEnv for Island {
    type Config = IslandConfig;
    type State = Self;

    /// Makes the island number `env`. It depends on the seed and this number alone, whatever the other islands are.
    fn new(config: &IslandConfig, seed: u64, env: usize) -> Self {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        rng.set_stream(env as u64);
        let mut island = Self {
            rng,
            agent: (0, 0),
            treasure: (0, 0),
            steps: 0,
        };
        island.begin_episode(config.side);
        island
    }

    fn render(&self, config: &IslandConfig, frame: &mut [u8]) {
        frame.fill(0);
        for ((row, column), shade) in [(self.treasure, 128), (self.agent, 255)] {
            frame[row * config.side + column] = shade;
        }
    }

    fn act(&mut self, config: &IslandConfig, action: u8) -> (f32, StepEnd) {
        let (down, right) = MOVES[usize::from(action)];
        let (row, column) = self.agent;
        let last = config.side - 1;
        self.agent = (
            row.saturating_add_signed(down).min(last),
            column.saturating_add_signed(right).min(last),
        );
        self.steps += 1;
        let (reward, end) = if self.agent == self.treasure {
            (config.reward, StepEnd::Terminal)
        } else if self.steps >= config.step_limit {
            (0.0, StepEnd::TimedOut)
        } else {
            (0.0, StepEnd::Running)
        };
        if end != StepEnd::Running {
            self.begin_episode(config.side);
        }
        (reward, end)
    }

    fn state(&self) -> Self {
        self.clone()
    }

    fn restore(&mut self, config: &IslandConfig, state: Self) -> Result<(), EnvError> {
        let is_outside = |(row, column): (usize, usize)| row.max(column) >= config.side;
        if is_outside(state.agent) || is_outside(state.treasure) {
            return Err(EnvError::State("a place beyond the island".into()));
        }
        *self = state;
        Ok(())
    }
}
