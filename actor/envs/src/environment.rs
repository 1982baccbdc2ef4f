//! The interface of a world: many environments, stepped together, that write straight into the caller's buffers.
//! It does not stack, enlarge or convert frames, and it keeps no statistics; those live where they are used.

use crate::error::EnvError;

/// The shape of one frame, channels last: `height` x `width` x `channels` bytes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct FrameShape {
    /// Rows.
    pub height: usize,
    /// Columns.
    pub width: usize,
    /// Bytes per pixel.
    pub channels: usize,
}

impl FrameShape {
    /// Creates the shape [H, W, C].
    pub const fn new(height: usize, width: usize, channels: usize) -> Self {
        Self {
            height,
            width,
            channels,
        }
    }

    /// Bytes in one frame.
    pub const fn bytes(&self) -> usize {
        self.height * self.width * self.channels
    }
}

/// What one step ended, if anything.
///
/// The frame after a step whose end is not `Running` is the first of another episode or level.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default)]
#[repr(u8)]
pub enum StepEnd {
    /// Nothing: the next frame follows from this one.
    #[default]
    Running = 0,
    /// The level was completed and the next one began; the return continues.
    LevelChange = 1,
    /// The episode was cut off by its step limit.
    TimedOut = 2,
    /// The episode ended.
    Terminal = 3,
}

/// The result of [`Environment::step`].
pub type StepResult = Result<(), EnvError>;

/// Environments of one game, stepped together.
///
/// Deterministic: the same construction arguments and actions give the same frames, rewards and ends.
/// An environment that ends resets by itself, so its next frame is the first of another episode (as in gym3 and Procgen).
pub trait Environment: Send {
    /// The shape of one frame.
    fn frame_shape(&self) -> FrameShape;

    /// Number of actions; valid ones are `0..num_actions`.
    fn num_actions(&self) -> usize;

    /// Number of environments, N.
    fn num_envs(&self) -> usize;

    /// Writes the current frames [N, H, W, C], in which the next actions are taken.
    fn observe(&mut self, frames: &mut [u8]);

    /// Takes `actions` [N] and writes what they earned, `rewards` [N], and what they ended, `ends` [N].
    ///
    /// # Errors
    /// An action out of range, or a fault of the engine. After an error the world must not be stepped again.
    fn step(&mut self, actions: &[u8], rewards: &mut [f32], ends: &mut [StepEnd]) -> StepResult;

    /// Returns the complete state of all environments, including their generators. A world made with the same arguments
    /// continues exactly as this one does after it [`load`](Self::load)s the state.
    ///
    /// # Errors
    /// [`EnvError::NotSaved`] if the world cannot do this, which is the default; or a fault of the engine.
    fn save(&mut self) -> Result<Vec<u8>, EnvError> {
        Err(EnvError::not_saved())
    }

    /// Restores a state from [`save`](Self::save). The caller must check that the bytes are undamaged and of the same settings.
    ///
    /// # Errors
    /// Bytes of another world or of another number of environments; the world must then not be used any more.
    fn load(&mut self, _state: &[u8]) -> Result<(), EnvError> {
        Err(EnvError::not_saved())
    }
}
