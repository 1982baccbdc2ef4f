//! A corridor with a small reward nearby and a large one far away. The best return is known; a learner must forgo the near reward.
//! It has no randomness, and all its environments are alike; it exists for fast learning tests.

use serde::{Deserialize, Serialize};

use crate::environment::{FrameShape, StepEnd};
use crate::envs::{SerialWorld, SingleEnv};
use crate::error::EnvError;
use crate::saved;
use crate::settings::{BuildResult, WorldSettings};

/// The cell in which every episode starts: beside the near end.
const START_CELL: usize = 1;

/// The settings of the corridor.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ChainConfig {
    /// Cells, both ends included; at least 3. More make the far end harder to find: a uniform random walk gets there
    /// before the near end with probability 1 / (`cells` - 1).
    pub cells: usize,
    /// Rows of a frame, in pixels, at least 1.
    pub height: usize,
    /// Columns of a frame, in pixels, at least `cells`.
    pub width: usize,
    /// Env steps after which an episode is cut off, at least 1.
    pub step_limit: u32,
    /// Reward of reaching the left end (cell 0), which ends the episode; the distractor.
    pub reward_left: f32,
    /// Reward of reaching the right end (the last cell), which ends the episode.
    pub reward_right: f32,
}

/// N corridors. A frame is black but for the band of columns that belongs to the agent's cell, which is white.
///
/// Actions: 0 no-op, 1 left, 2 right. Reaching an end is `Terminal`, also in the last step that the limit allows. The
/// seed has no effect, as nothing is random.
pub type ChainWorld = SerialWorld<Corridor>;

/// The agent's cell in one corridor, and the step of the episode. The saved state is this struct.
#[derive(Clone, Copy, Serialize, Deserialize)]
pub struct Corridor {
    cell: usize,
    episode_step: u32,
}

impl Corridor {
    const START: Self = Self {
        cell: START_CELL,
        episode_step: 0,
    };
}

impl WorldSettings for ChainConfig {
    fn validate(&self) -> Result<(), EnvError> {
        let (cells, width, height) = (self.cells, self.width, self.height);
        let (left, right) = (self.reward_left, self.reward_right);
        let text = if cells < 3 || width < cells || height == 0 || width.max(height) > 1024 {
            format!(
                "the chain needs cells >= 3, cells <= width <= 1024 and 1 <= height <= 1024, got cells = {cells}, width = {width}, \
                 height = {height}"
            )
        } else if self.step_limit == 0 {
            "the chain's step_limit must be at least 1, got 0".into()
        } else if !left.is_finite() || !right.is_finite() {
            format!(
                "the chain's rewards must be finite, got reward_left = {left} and reward_right = {right}"
            )
        } else {
            return Ok(());
        };
        Err(EnvError::Config(text))
    }

    /// `height` x `width` x 1.
    fn frame_shape(&self) -> FrameShape {
        FrameShape::new(self.height, self.width, 1)
    }

    fn action_names(&self) -> Vec<&str> {
        vec!["no-op", "left", "right"]
    }

    fn build(&self, num_envs: usize, seed: u64, _threads: usize) -> BuildResult {
        Ok(Box::new(ChainWorld::new(self, num_envs, seed)?))
    }
}

impl SingleEnv for Corridor {
    type Config = ChainConfig;
    type State = Self;

    fn new(_: &ChainConfig, _seed: u64, _env: usize) -> Self {
        Self::START
    }

    fn render(&self, config: &ChainConfig, frame: &mut [u8]) {
        let (cell, cells, width) = (self.cell, config.cells, config.width);
        frame.fill(0);
        for row in frame.chunks_exact_mut(width) {
            row[cell * width / cells..(cell + 1) * width / cells].fill(255);
        }
    }

    fn act(&mut self, config: &ChainConfig, action: u8) -> (f32, StepEnd) {
        match action {
            1 => self.cell -= 1,
            2 => self.cell += 1,
            _ => {}
        }
        self.episode_step += 1;
        let (reward, end) = match self.cell {
            0 => (config.reward_left, StepEnd::Terminal),
            it if it == config.cells - 1 => (config.reward_right, StepEnd::Terminal),
            _ if self.episode_step >= config.step_limit => (0.0, StepEnd::TimedOut),
            _ => (0.0, StepEnd::Running),
        };
        if end != StepEnd::Running {
            *self = Self::START;
        }
        (reward, end)
    }

    fn state(&self) -> Self {
        *self
    }

    fn restore(&mut self, config: &ChainConfig, state: Self) -> Result<(), EnvError> {
        saved::ensure_fits((1..config.cells - 1).contains(&state.cell), "a cell")?;
        *self = state;
        Ok(())
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use crate::playing::{frames, step};

    /// A corridor with the reward 0.1 at the near end and 1 at the far end.
    pub(crate) fn config() -> ChainConfig {
        ChainConfig {
            cells: 8,
            height: 12,
            width: 12,
            step_limit: 30,
            reward_left: 0.1,
            reward_right: 1.0,
        }
    }

    /// Return and end of the first episode under a fixed action.
    fn play(config: &ChainConfig, action: u8) -> (f32, StepEnd) {
        let mut world = ChainWorld::new(config, 1, 0).unwrap();
        let mut total = 0.0;
        loop {
            let (rewards, ends) = step(&mut world, &[action]);
            total += rewards[0];
            if ends[0] != StepEnd::Running {
                return (total, ends[0]);
            }
        }
    }

    #[test]
    fn ends_are_terminal_at_the_ends_and_timed_out_between() {
        assert_eq!(play(&config(), 0), (0.0, StepEnd::TimedOut));
        assert_eq!(play(&config(), 1), (0.1, StepEnd::Terminal));
        assert_eq!(play(&config(), 2), (1.0, StepEnd::Terminal));
        for (step_limit, end) in [(6, StepEnd::Terminal), (5, StepEnd::TimedOut)] {
            let config = ChainConfig {
                step_limit,
                ..config()
            };
            assert_eq!(play(&config, 2).1, end);
        }
    }

    #[test]
    fn each_cell_has_its_own_frame() {
        let mut world = ChainWorld::new(&config(), 2, 0).unwrap();
        let mut seen = std::collections::BTreeSet::new();
        for _ in 1..7 {
            assert!(seen.insert(frames(&mut world)[144..].to_vec()));
            step(&mut world, &[0, 2]);
        }
        let frames = frames(&mut world);
        // The second environment started again, the first never moved.
        assert_eq!(frames[..144], frames[144..]);
        assert_eq!(seen.len(), 6);
    }
}
