//! The interface of a world's settings: what a run must know of a world before it is built, and how to build it.
//! `worlds` lists the worlds.

use std::time::Duration;

use crate::environment::{Environment, FrameShape};
use crate::error::EnvError;

/// The result of [`WorldSettings::build`].
pub type BuildResult = Result<Box<dyn Environment>, EnvError>;

/// The settings of one world.
///
/// They are read from TOML, where unknown keys are errors and only optional fields have defaults. A world implements
/// the methods that have no body here, and overrides those whose default does not fit it.
pub trait WorldSettings {
    /// # Errors
    /// A setting is invalid; the message names it and says which values work.
    fn validate(&self) -> Result<(), EnvError>;

    /// The shape of one frame.
    fn frame_shape(&self) -> FrameShape;

    /// The names of the actions; an action is an index into this list, so there are at most 255.
    fn action_names(&self) -> Vec<&str>;

    /// Steps per second at which a person can play or follow the game.
    fn steps_per_second(&self) -> f64 {
        10.0
    }

    /// Builds `num_envs` environments; environment i depends on (`seed`, i) and its actions only. The world may start `threads` threads.
    fn build(&self, num_envs: usize, seed: u64, threads: usize) -> BuildResult;

    /// The variants of this world that have their own names on a command line, such as a suite's games.
    fn variants() -> Variants
    where
        Self: Sized,
    {
        Variants::default()
    }

    /// The variant that these settings select, one of [`variants`](Self::variants).
    fn variant(&self) -> Option<&str> {
        None
    }

    /// The path of the library that is loaded instead of the world's own, if any.
    fn library(&self) -> Option<&str> {
        None
    }

    /// Returns for each action one that does the same in this world. One action of each such group maps to itself.
    fn visible_actions(&self) -> Vec<u8> {
        let count = self.action_names().len();
        (0..count).map(|action| action as u8).collect()
    }

    /// Whether a run in this world can be resumed, with new episodes: false if one episode's state influences the next.
    fn is_resumable(&self) -> bool {
        true
    }

    /// How long the start and `steps` steps may take before the world itself reports an error; zero if it does not measure time.
    fn steps_time_max(&self, _steps: u32) -> Duration {
        Duration::ZERO
    }

    /// Installs what the world needs on this machine; `progress` gets a line for each step.
    ///
    /// # Errors
    /// Something is missing; the message says what, and how to get it.
    fn install(&self, _progress: &mut dyn FnMut(&str)) -> Result<(), EnvError> {
        Ok(())
    }
}

/// The variants of one world, each named `world:variant` on a command line. The default is a world without variants.
#[derive(Clone, Copy, Debug, Default)]
pub struct Variants {
    /// The setting that selects the variant. In capitals it stands for the variant in help texts.
    pub key: &'static str,
    /// The names of the variants; empty for a world without variants.
    pub names: &'static [&'static str],
    /// Whether any other text is a variant too, such as a command.
    pub is_free_text: bool,
}
