//! A world of a user's own, in any language: copies stepped by a process that the actor starts. Here are its settings: the command, and
//! what it declares.
//! What is said to the process and what it answers is in `protocol`.

mod process;
mod protocol;
#[cfg(test)]
mod tests;
mod world;

use std::time::Duration;

use rand::Rng;
use serde::{Deserialize, Serialize};
use tracing::Level;

use self::process::{Patience, WorldProcess};
use self::protocol::{Declaration, Request};
use crate::copies::{RngUse, copy_rng};
use crate::environment::FrameShape;
use crate::error::EnvError;

pub use self::world::ExecWorld;
pub use crate::error::ExecError;

/// Longest side of a frame, in pixels.
const SIDE_MAX: usize = 4096;

/// Most bytes a pixel.
const CHANNELS_MAX: usize = 16;

/// Most actions of a world: the wire numbers them with a byte.
const ACTIONS_MAX: usize = 255;

/// Bounds of a time limit, in milliseconds: a day at most.
const LIMIT_MS: std::ops::RangeInclusive<u64> = 1..=86_400_000;

/// A command, and the world that it declared when the run was made. Each actor checks that its own process declares the same.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ExecConfig {
    /// What is started, by `sh`, in the folder in which the actor runs.
    pub command: String,
    /// Rows of a frame, as declared.
    pub height: usize,
    /// Columns of a frame, as declared.
    pub width: usize,
    /// Bytes a pixel, as declared: 1 is grey, 3 are colours.
    pub channels: usize,
    /// The names of the actions, as declared.
    pub actions: Vec<String>,
    /// How long the process may take to declare itself, for its first frames and to load a state, milliseconds; then it is killed.
    pub start_timeout_ms: u64,
    /// How long a step of all copies may take, and to save their state, milliseconds; then the process is killed.
    pub step_timeout_ms: u64,
}

impl ExecConfig {
    /// # Errors
    /// Says which setting cannot work.
    pub fn validate(&self) -> Result<(), EnvError> {
        let bad = |text: String| Err(EnvError::Config(text));
        if self.command.trim().is_empty() {
            return bad(
                "exec: without a command; give one, as in --env \"exec:python3 world.py\"".into(),
            );
        }
        let sides = [self.height, self.width];
        if sides.iter().any(|side| !(1..=SIDE_MAX).contains(side))
            || !(1..=CHANNELS_MAX).contains(&self.channels)
        {
            return bad(format!(
                "the world `{}` declares frames of {} x {} x {}; 1 x 1 x 1 to {SIDE_MAX} x {SIDE_MAX} x {CHANNELS_MAX} bytes are possible, \
                 rows first, channels last",
                self.command, self.height, self.width, self.channels
            ));
        }
        if !(1..=ACTIONS_MAX).contains(&self.actions.len()) {
            return bad(format!(
                "the world `{}` declares {} actions; 1 to {ACTIONS_MAX} are possible",
                self.command,
                self.actions.len()
            ));
        }
        for (name, value) in [
            ("start_timeout_ms", self.start_timeout_ms),
            ("step_timeout_ms", self.step_timeout_ms),
        ] {
            if !LIMIT_MS.contains(&value) {
                return bad(format!(
                    "world.{name} = {value}; 1 to {} milliseconds are possible",
                    LIMIT_MS.end()
                ));
            }
        }
        Ok(())
    }

    /// `height` x `width` x `channels`.
    pub const fn frame_shape(&self) -> FrameShape {
        FrameShape {
            height: self.height,
            width: self.width,
            channels: self.channels,
        }
    }

    const fn start_patience(&self) -> Patience {
        start_patience(self.start_timeout_ms)
    }

    const fn step_patience(&self) -> Patience {
        Patience {
            limit: Duration::from_millis(self.step_timeout_ms),
            setting: "world.step_timeout_ms",
        }
    }

    /// What a declaration must be for this world, in words.
    fn in_words(&self) -> String {
        in_words(self.frame_shape(), &self.actions)
    }
}

fn in_words(shape: FrameShape, actions: &[String]) -> String {
    format!(
        "frames of {} x {} x {} and the {} actions {}",
        shape.height,
        shape.width,
        shape.channels,
        actions.len(),
        actions.join(", ")
    )
}

const fn start_patience(timeout_ms: u64) -> Patience {
    Patience {
        limit: Duration::from_millis(timeout_ms),
        setting: "world.start_timeout_ms",
    }
}

/// Starts a world's process, asks it for a copy for each of `seeds`, and hears what it declares. Its stderr is logged at `level`.
fn introduce(
    command: &str,
    patience: Patience,
    seeds: Vec<u32>,
    level: Level,
) -> Result<(WorldProcess, Declaration), ExecError> {
    let mut process = WorldProcess::start(command, level)?;
    let doing = "before it declared itself";
    process.say_line(b"", &Request::new(seeds), doing)?;
    let line = process.line(patience, doing)?;
    let declaration = Declaration::parse(&line).map_err(|fault| process.fail(fault))?;
    Ok((process, declaration))
}

/// Asks a command what world it is: starts it with one copy, hears its declaration, ends it.
///
/// # Errors
/// A command that cannot be started, does not declare a world in time, or one that no run can be made of.
pub fn declaration(
    command: &str,
    start_timeout_ms: u64,
    step_timeout_ms: u64,
) -> Result<ExecConfig, EnvError> {
    let (process, declared) = introduce(
        command,
        start_patience(start_timeout_ms),
        vec![0],
        Level::DEBUG,
    )?;
    drop(process);
    let config = ExecConfig {
        command: command.into(),
        height: declared.height,
        width: declared.width,
        channels: declared.channels,
        actions: declared.actions,
        start_timeout_ms,
        step_timeout_ms,
    };
    config.validate()?;
    Ok(config)
}

/// The seed of each copy, below 2^31 so that every language and engine has room for it.
fn seeds(seed: u64, copies: usize) -> Vec<u32> {
    (0..copies)
        .map(|copy| copy_rng(seed, copy, RngUse::Game).random::<u32>() >> 1)
        .collect()
}
