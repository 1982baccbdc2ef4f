//! The settings of a world that is a process: the command, and what it declares. Nothing is started here.

use std::time::Duration;

use serde::{Deserialize, Serialize};

use super::process::Patience;
use crate::environment::FrameShape;
use crate::error::EnvError;

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

    pub(super) const fn start_patience(&self) -> Patience {
        start_patience(self.start_timeout_ms)
    }

    pub(super) const fn step_patience(&self) -> Patience {
        Patience {
            limit: Duration::from_millis(self.step_timeout_ms),
            setting: "world.step_timeout_ms",
        }
    }
}

/// What a process declares, in words.
pub(super) fn in_words(shape: FrameShape, actions: &[String]) -> String {
    format!(
        "frames of {} x {} x {} and the {} actions {}",
        shape.height,
        shape.width,
        shape.channels,
        actions.len(),
        actions.join(", ")
    )
}

pub(super) const fn start_patience(timeout_ms: u64) -> Patience {
    Patience {
        limit: Duration::from_millis(timeout_ms),
        setting: "world.start_timeout_ms",
    }
}
