//! A world restricted to some of its actions, and to frames without the right and bottom borders that no layer reads.
//! Those borders are neither kept nor sent. Each world says which actions do the same; the caller says which part of a frame is read.

use serde::{Deserialize, Serialize};

use crate::environment::{Environment, FrameShape, StepEnd, StepResult};
use crate::envs::check_frames;
use crate::error::{EnvError, require};

/// The set of a world's actions among which an agent chooses.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum ActionSet {
    /// All of the world's actions.
    #[default]
    All,
    /// One action of each group that does the same in this world. Exploration and the network then choose among fewer
    /// actions, so both the exploration and the learning differ.
    Visible,
}

/// A world with some of another world's actions, numbered without gaps, and the upper left part of its frames.
pub struct RestrictedWorld {
    world: Box<dyn Environment>,
    actions: Vec<u8>,
    /// The actions of the step in progress [N], as `world` numbers them.
    step_actions: Vec<u8>,
    shape: FrameShape,
    /// Whole frames of all environments: a reused buffer.
    whole_frames: Vec<u8>,
}

impl RestrictedWorld {
    /// Restricts `world` to `actions` and to frames of (height, width). Returns `world` unchanged if these are all it has.
    ///
    /// # Errors
    /// No action, or one that the world does not have; frames larger than the world's, or without a pixel.
    pub fn wrap(
        world: Box<dyn Environment>,
        actions: Vec<u8>,
        (height, width): (usize, usize),
    ) -> Result<Box<dyn Environment>, EnvError> {
        let (whole_shape, count) = (world.frame_shape(), world.num_actions());
        let shape = FrameShape::new(height, width, whole_shape.channels);
        let has_all_actions = actions.iter().map(|&it| usize::from(it)).eq(0..count);
        if shape == whole_shape && has_all_actions {
            return Ok(world);
        }
        let mut known = actions.iter().map(|&it| usize::from(it) < count);
        let why = format!("{actions:?} are not actions of a world that has {count}");
        require(!actions.is_empty() && known.all(|known| known), why)?;
        let (rows, columns) = (whole_shape.height, whole_shape.width);
        let why =
            format!("frames of {height} x {width} cannot be cut from frames of {rows} x {columns}");
        require(
            (1..=rows).contains(&height) && (1..=columns).contains(&width),
            why,
        )?;
        let envs = world.num_envs();
        Ok(Box::new(Self {
            world,
            actions,
            step_actions: Vec::with_capacity(envs),
            shape,
            whole_frames: vec![0; envs * whole_shape.bytes()],
        }))
    }
}

impl Environment for RestrictedWorld {
    fn frame_shape(&self) -> FrameShape {
        self.shape
    }

    fn num_actions(&self) -> usize {
        self.actions.len()
    }

    fn num_envs(&self) -> usize {
        self.world.num_envs()
    }

    fn observe(&mut self, frames: &mut [u8]) {
        check_frames(frames, self.num_envs(), self.shape);
        self.world.observe(&mut self.whole_frames);
        let whole_shape = self.world.frame_shape();
        let [whole_row, row] = [whole_shape, self.shape].map(|it| it.width * it.channels);
        let whole = self.whole_frames.chunks_exact(whole_shape.bytes());
        for (part, whole) in frames.chunks_exact_mut(self.shape.bytes()).zip(whole) {
            let rows = whole.chunks_exact(whole_row);
            for (part, whole) in part.chunks_exact_mut(row).zip(rows) {
                part.copy_from_slice(&whole[..row]);
            }
        }
    }

    fn step(&mut self, actions: &[u8], rewards: &mut [f32], ends: &mut [StepEnd]) -> StepResult {
        self.step_actions.clear();
        for &action in actions {
            let Some(&raw) = self.actions.get(usize::from(action)) else {
                let count = self.actions.len();
                return Err(EnvError::Step(format!("action {action} of {count}")));
            };
            self.step_actions.push(raw);
        }
        self.world.step(&self.step_actions, rewards, ends)
    }

    fn save(&mut self) -> Result<Vec<u8>, EnvError> {
        self.world.save()
    }

    fn load(&mut self, state: &[u8]) -> Result<(), EnvError> {
        self.world.load(state)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::playing::{frames, step};
    use crate::settings::WorldSettings;
    use crate::worlds::chain::{ChainConfig, tests::config};

    /// Two corridors with frames of 4 x 6.
    fn restricted(actions: &[u8], size: (usize, usize)) -> Result<Box<dyn Environment>, EnvError> {
        let config = ChainConfig {
            cells: 3,
            height: 4,
            width: 6,
            reward_left: -1.0,
            ..config()
        };
        RestrictedWorld::wrap(config.build(2, 1, 0)?, actions.to_vec(), size)
    }

    #[test]
    fn actions_and_frames_are_the_world_s_own() {
        let mut world = restricted(&[2, 1], (2, 3)).unwrap();
        assert_eq!((world.num_envs(), world.num_actions()), (2, 2));
        assert_eq!(world.frame_shape().bytes(), 6);
        // The agent's cell is the middle one: columns 2 and 3.
        assert_eq!(frames(&mut *world), [0, 0, 255].repeat(4));
        // Right is 2 in the corridor, left 1.
        let (mut rewards, mut ends) = step(&mut *world, &[0, 1]);
        assert_eq!(rewards, [1.0, -1.0]);
        assert_eq!(ends, [StepEnd::Terminal; 2]);
        assert!(world.step(&[0, 2], &mut rewards, &mut ends).is_err());
        // No-op is 0, and left is not among these.
        let mut world = restricted(&[0, 2], (2, 3)).unwrap();
        let (rewards, ends) = step(&mut *world, &[1, 0]);
        assert_eq!(rewards, [1.0, 0.0]);
        assert_eq!(ends, [StepEnd::Terminal, StepEnd::Running]);
    }

    #[test]
    fn the_whole_is_the_world_as_it_is_and_what_it_has_not_is_refused() {
        let all = restricted(&[0, 1, 2], (4, 6)).unwrap();
        assert_eq!((all.num_actions(), all.frame_shape().bytes()), (3, 24));
        for wrong in [&[][..], &[3], &[0, 1, 2, 3]] {
            assert!(restricted(wrong, (4, 6)).is_err(), "{wrong:?}");
        }
        for size in [(5, 6), (4, 7), (0, 6), (4, 0)] {
            assert!(restricted(&[0, 1, 2], size).is_err(), "{size:?}");
        }
    }
}
