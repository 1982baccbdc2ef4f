//! The settings of a world that is a process: the command, and what it declares. Nothing is started here.

use std::time::Duration;

use serde::{Deserialize, Serialize};

use super::process::Patience;

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
    pub(super) const fn start_patience(&self) -> Patience {
        Patience {
            limit: Duration::from_millis(self.start_timeout_ms),
            setting: "world.start_timeout_ms",
        }
    }

    pub(super) const fn step_patience(&self) -> Patience {
        Patience {
            limit: Duration::from_millis(self.step_timeout_ms),
            setting: "world.step_timeout_ms",
        }
    }

    /// What it declares, in words.
    pub(super) fn describe(&self) -> String {
        format!(
            "frames of {} x {} x {} and the {} actions {}",
            self.height,
            self.width,
            self.channels,
            self.actions.len(),
            self.actions.join(", ")
        )
    }
}
