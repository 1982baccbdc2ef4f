//! Copies of a game in a process of their own, as the trait has them: a byte to the process and one back for each step.

use tracing::Level;

use super::block::Block;
use super::config::{ExecConfig, in_words, introduce, seeds};
use super::error::{ExecError, Fault};
use super::messages::Opening;
use super::process::{Patience, WorldProcess};
use crate::copies::{check_num_envs, check_step};
use crate::environment::{Environment, FrameShape, StepEnd};
use crate::error::EnvError;
use crate::settings::{Variants, WorldSettings};

/// Says that the actions lie in the block.
const STEP: u8 = b's';

/// Says that the frames lie there, and after a step rewards and ends.
const DONE: u8 = b'.';

/// Copies of one game, stepped by a process of their own.
pub struct ExecWorld {
    process: WorldProcess,
    block: Block,
    shape: FrameShape,
    num_actions: usize,
    num_envs: usize,
    step_patience: Patience,
}

impl ExecWorld {
    /// Starts the process and waits for the first frames.
    ///
    /// # Errors
    /// A command that cannot be started, another world than `config` says, or one that takes too long.
    pub fn new(config: &ExecConfig, num_envs: usize, seed: u64) -> Result<Self, EnvError> {
        config.validate()?;
        check_num_envs(num_envs)?;
        let patience = config.start_patience();
        let (mut process, declared) = introduce(
            &config.command,
            patience,
            seeds(seed, num_envs),
            Level::INFO,
        )?;
        let shape = FrameShape {
            height: declared.height,
            width: declared.width,
            channels: declared.channels,
        };
        if shape != config.frame_shape() || declared.actions != config.actions {
            let other = Fault::OtherShape {
                found: in_words(shape, &declared.actions),
                promised: config.in_words(),
            };
            return Err(process.fail(other).into());
        }
        if declared.copies != num_envs {
            let other = Fault::OtherCopies {
                found: declared.copies,
                asked: num_envs,
            };
            return Err(process.fail(other).into());
        }
        let block = Block::new(num_envs, shape).map_err(|source| {
            let doing = "making the memory that it shares";
            process.fail(Fault::System { doing, source })
        })?;
        let path = block.path();
        let opening = Opening {
            block: &path,
            layout: block.layout(),
        };
        let mut line = serde_json::to_vec(&opening).expect("plain numbers are JSON");
        line.push(b'\n');
        let doing = "before its first frames";
        process.say(&line, doing)?;
        let mut world = Self {
            process,
            block,
            shape,
            num_actions: config.actions.len(),
            num_envs,
            step_patience: config.step_patience(),
        };
        world.hear_done(patience, doing)?;
        Ok(world)
    }

    fn hear_done(&mut self, patience: Patience, doing: &'static str) -> Result<(), ExecError> {
        match self.process.byte(patience, doing)? {
            DONE => Ok(()),
            byte => Err(self.process.fail(Fault::OtherByte { byte })),
        }
    }
}

impl WorldSettings for ExecConfig {
    fn validate(&self) -> Result<(), EnvError> {
        ExecConfig::validate(self)
    }

    fn frame_shape(&self) -> FrameShape {
        ExecConfig::frame_shape(self)
    }

    fn action_names(&self) -> Vec<&str> {
        self.actions.iter().map(String::as_str).collect()
    }

    fn build(
        &self,
        num_envs: usize,
        seed: u64,
        _threads: usize,
    ) -> Result<Box<dyn Environment>, EnvError> {
        Ok(Box::new(ExecWorld::new(self, num_envs, seed)?))
    }

    fn variants() -> Variants {
        Variants {
            key: "command",
            names: &[],
            is_open: true,
        }
    }

    fn variant(&self) -> Option<&str> {
        Some(&self.command)
    }
}

impl Environment for ExecWorld {
    fn frame_shape(&self) -> FrameShape {
        self.shape
    }

    fn num_actions(&self) -> usize {
        self.num_actions
    }

    fn num_envs(&self) -> usize {
        self.num_envs
    }

    fn observe(&mut self, frames: &mut [u8]) {
        assert_eq!(
            frames.len(),
            self.num_envs * self.shape.bytes(),
            "observe needs room for every copy's frame"
        );
        self.block
            .read_frames(frames)
            .expect("it is memory of this process, whose size is sealed");
    }

    fn step(
        &mut self,
        actions: &[u8],
        rewards: &mut [f32],
        ends: &mut [StepEnd],
    ) -> Result<(), EnvError> {
        check_step(self.num_envs, self.num_actions, actions, rewards, ends)?;
        let doing = "in the middle of a step";
        if let Err(source) = self.block.write_actions(actions) {
            return Err(self.process.fail(Fault::System { doing, source }).into());
        }
        self.process.say(&[STEP], doing)?;
        self.hear_done(self.step_patience, doing)?;
        let numbers = match self.block.read_results(rewards) {
            Ok(numbers) => numbers,
            Err(source) => return Err(self.process.fail(Fault::System { doing, source }).into()),
        };
        for (copy, (end, &number)) in ends.iter_mut().zip(numbers).enumerate() {
            *end = match number {
                0 => StepEnd::Running,
                1 => StepEnd::LevelChange,
                2 => StepEnd::TimedOut,
                3 => StepEnd::Terminal,
                end => return Err(self.process.fail(Fault::End { copy, end }).into()),
            };
        }
        if let Some(copy) = rewards.iter().position(|reward| !reward.is_finite()) {
            let reward = rewards[copy];
            return Err(self.process.fail(Fault::Reward { copy, reward }).into());
        }
        Ok(())
    }
}
