//! Which of a world's actions an agent chooses among, and a world that takes those alone.
//! Which actions do the same is for each world to say.

use serde::{Deserialize, Serialize};

use crate::environment::{Environment, FrameShape, StepEnd};
use crate::error::EnvError;

/// Which of a world's actions an agent chooses among.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum ActionSet {
    /// All that the world takes.
    #[default]
    All,
    /// One of those that do the same in this world. Chance and the network choose among fewer then, so neither what is explored nor
    /// what is learned is the same.
    Visible,
}

/// Another world's actions, some of them, numbered without gaps.
pub struct FewerActions {
    world: Box<dyn Environment>,
    /// What each action is in the world.
    actions: Vec<u8>,
    /// The world's actions of the step in progress [N].
    step: Vec<u8>,
}

impl FewerActions {
    /// `world` with a subset `actions` of its actions; unchanged where these are all.
    ///
    /// # Errors
    /// No action, or one that the world does not have.
    pub fn of(
        world: Box<dyn Environment>,
        actions: Vec<u8>,
    ) -> Result<Box<dyn Environment>, EnvError> {
        let count = world.num_actions();
        if actions.len() == count && actions.iter().map(|&it| usize::from(it)).eq(0..count) {
            return Ok(world);
        }
        if actions.is_empty() || actions.iter().any(|&it| usize::from(it) >= count) {
            return Err(EnvError::Config(format!(
                "{actions:?} are not actions of a world that has {count}"
            )));
        }
        Ok(Box::new(Self {
            step: vec![0; world.num_envs()],
            actions,
            world,
        }))
    }
}

impl Environment for FewerActions {
    fn frame_shape(&self) -> FrameShape {
        self.world.frame_shape()
    }

    fn num_actions(&self) -> usize {
        self.actions.len()
    }

    fn num_envs(&self) -> usize {
        self.world.num_envs()
    }

    fn observe(&mut self, frames: &mut [u8]) {
        self.world.observe(frames);
    }

    fn step(
        &mut self,
        actions: &[u8],
        rewards: &mut [f32],
        ends: &mut [StepEnd],
    ) -> Result<(), EnvError> {
        self.step.clear();
        for &action in actions {
            let Some(&own) = self.actions.get(usize::from(action)) else {
                let count = self.actions.len();
                return Err(EnvError::Config(format!("action {action} of {count}")));
            };
            self.step.push(own);
        }
        self.world.step(&self.step, rewards, ends)
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
    use crate::registry::WorldConfig;
    use crate::worlds::corridor::CorridorConfig;

    fn corridor() -> Box<dyn Environment> {
        let config = WorldConfig::Chain(CorridorConfig {
            cells: 3,
            height: 1,
            width: 3,
            step_limit: 9,
            reward_left: -1.0,
            reward_right: 1.0,
        });
        config.build(2, 1, 0).unwrap()
    }

    #[test]
    fn fewer_actions_are_the_world_s_own() {
        let mut world = FewerActions::of(corridor(), vec![2, 1]).unwrap();
        assert_eq!((world.num_actions(), world.num_envs()), (2, 2));
        let (mut rewards, mut ends) = ([0.0; 2], [StepEnd::Running; 2]);
        // Right is 2 in the corridor, left 1.
        world.step(&[0, 1], &mut rewards, &mut ends).unwrap();
        assert_eq!(rewards, [1.0, -1.0]);
        assert!(world.step(&[0, 2], &mut rewards, &mut ends).is_err());
    }

    #[test]
    fn all_actions_are_the_world_as_it_is_and_others_are_refused() {
        let all = FewerActions::of(corridor(), vec![0, 1, 2]).unwrap();
        assert_eq!(all.num_actions(), 3);
        for wrong in [vec![], vec![3], vec![0, 1, 2, 3]] {
            assert!(
                FewerActions::of(corridor(), wrong.clone()).is_err(),
                "{wrong:?}"
            );
        }
    }
}
