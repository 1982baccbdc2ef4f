//! A world whose frames are cut at the right and at the bottom: where nothing reads those borders, nothing keeps or sends them.
//! It does not know who reads what; it is told a size.

use crate::environment::{Environment, FrameShape, StepEnd};
use crate::error::EnvError;

/// The upper left part of another world's frames.
pub struct CutFrames {
    world: Box<dyn Environment>,
    whole: FrameShape,
    part: FrameShape,
    /// Whole frames of all copies: memory to use again.
    frames: Vec<u8>,
}

impl CutFrames {
    /// `world` with frames of (height, width); unchanged where its frames have that size.
    ///
    /// # Errors
    /// Frames larger than the world's, or without a pixel.
    pub fn of(
        world: Box<dyn Environment>,
        (height, width): (usize, usize),
    ) -> Result<Box<dyn Environment>, EnvError> {
        let whole = world.frame_shape();
        let part = FrameShape {
            height,
            width,
            channels: whole.channels,
        };
        if part == whole {
            return Ok(world);
        }
        if height.min(width) == 0 || height > whole.height || width > whole.width {
            return Err(EnvError::Config(format!(
                "frames of {height} x {width} cannot be cut from frames of {} x {}",
                whole.height, whole.width
            )));
        }
        Ok(Box::new(Self {
            frames: vec![0; world.num_envs() * whole.bytes()],
            world,
            whole,
            part,
        }))
    }
}

impl Environment for CutFrames {
    fn frame_shape(&self) -> FrameShape {
        self.part
    }

    fn num_actions(&self) -> usize {
        self.world.num_actions()
    }

    fn num_envs(&self) -> usize {
        self.world.num_envs()
    }

    fn observe(&mut self, frames: &mut [u8]) {
        assert_eq!(
            frames.len(),
            self.num_envs() * self.part.bytes(),
            "the buffer holds one frame for each copy"
        );
        self.world.observe(&mut self.frames);
        let [whole_row, row] = [self.whole, self.part].map(|shape| shape.width * shape.channels);
        let whole = self.frames.chunks_exact(self.whole.bytes());
        for (part, whole) in frames.chunks_exact_mut(self.part.bytes()).zip(whole) {
            let rows = whole.chunks_exact(whole_row);
            for (part, whole) in part.chunks_exact_mut(row).zip(rows) {
                part.copy_from_slice(&whole[..row]);
            }
        }
    }

    fn step(
        &mut self,
        actions: &[u8],
        rewards: &mut [f32],
        ends: &mut [StepEnd],
    ) -> Result<(), EnvError> {
        self.world.step(actions, rewards, ends)
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
            height: 4,
            width: 6,
            step_limit: 9,
            reward_left: 0.0,
            reward_right: 1.0,
        });
        config.build(2, 1, 0).unwrap()
    }

    #[test]
    fn frames_are_cut_and_all_else_is_the_world_s() {
        let mut world = CutFrames::of(corridor(), (2, 3)).unwrap();
        assert_eq!((world.num_envs(), world.num_actions()), (2, 3));
        assert_eq!(world.frame_shape().bytes(), 6);
        let mut frames = [7; 12];
        // The agent's cell is the middle one: columns 2 and 3.
        world.observe(&mut frames);
        assert_eq!(frames, [0, 0, 255].repeat(4)[..]);
        let (mut rewards, mut ends) = ([0.0; 2], [StepEnd::Running; 2]);
        world.step(&[2, 0], &mut rewards, &mut ends).unwrap();
        assert_eq!(rewards, [1.0, 0.0]);
        assert_eq!(ends, [StepEnd::Terminal, StepEnd::Running]);
    }

    #[test]
    fn whole_frames_stay_as_they_are_and_larger_ones_are_refused() {
        let shape = corridor().frame_shape();
        let whole = CutFrames::of(corridor(), (4, 6)).unwrap();
        assert_eq!(whole.frame_shape(), shape);
        for size in [(5, 6), (4, 7), (0, 6), (4, 0)] {
            assert!(CutFrames::of(corridor(), size).is_err(), "{size:?}");
        }
    }
}
