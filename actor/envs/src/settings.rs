//! What a run must know of a world before it is built, and how it is built.
//! Which worlds there are is for `registry`.

use crate::environment::{Environment, FrameShape};
use crate::error::EnvError;

/// Levels that a trained policy is judged on.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Levels {
    /// As trained on.
    Train,
    /// Those trained on, and each episode is one level.
    TrainSingle,
    /// Levels that training has not seen; each episode is one.
    Unseen,
}

/// What [`WorldSettings::build`] gives.
pub type Built = Result<Box<dyn Environment>, EnvError>;

/// The settings of one world.
///
/// They are read from TOML, where unknown keys are errors, and have no defaults. A world implements the methods that have no body
/// here, and those others that answer something else for it.
pub trait WorldSettings {
    /// # Errors
    /// Says which setting cannot work, and what would.
    fn validate(&self) -> Result<(), EnvError>;

    /// The shape of one frame.
    fn frame_shape(&self) -> FrameShape;

    /// The names of the actions; an action is a place in this list, so there are at most 255.
    fn action_names(&self) -> Vec<&str>;

    /// Steps a second at which a person plays the game, or can follow it.
    fn steps_per_second(&self) -> f64 {
        10.0
    }

    /// Builds `num_envs` environments. Environment i depends on (`seed`, i) and its actions only. `threads` is how many threads
    /// the world may start, 0 for none.
    fn build(&self, num_envs: usize, seed: u64, threads: usize) -> Built;

    /// The kinds of this world that are worlds of their own on a command line, such as a suite's games.
    fn variants() -> Variants
    where
        Self: Sized,
    {
        Variants::default()
    }

    /// Which of [`variants`](Self::variants) this is.
    fn variant(&self) -> Option<&str> {
        None
    }

    /// The library that is loaded instead of the world's own, by its path.
    fn library(&self) -> Option<&str> {
        None
    }

    /// For each action, the one that it amounts to; an action that stands for itself maps to itself.
    fn visible_actions(&self) -> Vec<u8> {
        let count = self.action_names().len();
        (0..count).map(|action| action as u8).collect()
    }

    /// Whether a run in this world can be resumed, which begins its episodes anew: false where the world continues from one
    /// episode to the next.
    fn is_resumable(&self) -> bool {
        true
    }

    /// Puts what the world needs onto this machine; `progress` is told what is being done, a line at a time.
    ///
    /// # Errors
    /// What is missing, and how to get it.
    fn install(&self, _progress: &mut dyn FnMut(&str)) -> Result<(), EnvError> {
        Ok(())
    }
}

/// Kinds of one world, each named on a command line as `world:variant`; the default is that there is one world alone.
#[derive(Clone, Copy, Debug, Default)]
pub struct Variants {
    /// The setting that says which; its capitals stand for the variant in help texts.
    pub key: &'static str,
    /// Their names; none for a world that is only one.
    pub names: &'static [&'static str],
    /// Whether every other name is one too, such as a command.
    pub is_open: bool,
}
