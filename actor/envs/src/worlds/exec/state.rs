//! The saved state of a world that is a process of its own: the process's bytes, what lies in the block, and whose they are.

use serde::{Deserialize, Serialize};

use super::config::ExecConfig;
use crate::error::EnvError;
use crate::saved;

/// Longest state that a process may give for all its copies together, bytes.
pub(super) const WORLD_STATE_BYTES_MAX: u64 = 64 << 20;

/// How a world stands, and which world it is.
#[derive(Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct SavedExec {
    command: String,
    copies: usize,
    /// Rows, columns, bytes a pixel.
    shape: [usize; 3],
    actions: Vec<String>,
    /// Those in which the next actions are taken [N, H, W, C].
    pub(super) frames: Vec<u8>,
    /// The process's own bytes.
    pub(super) state: Vec<u8>,
}

impl SavedExec {
    pub(super) fn new(config: &ExecConfig, copies: usize, frames: Vec<u8>, state: Vec<u8>) -> Self {
        Self {
            command: config.command.clone(),
            copies,
            shape: [config.height, config.width, config.channels],
            actions: config.actions.clone(),
            frames,
            state,
        }
    }

    /// # Errors
    /// Serde cannot write it.
    pub(super) fn to_bytes(&self) -> Result<Vec<u8>, EnvError> {
        saved::encode(self)
    }

    /// # Errors
    /// Bytes that are no such state, or a state of another world than the one of `config` with so many copies.
    pub(super) fn from_bytes(
        bytes: &[u8],
        config: &ExecConfig,
        num_envs: usize,
    ) -> Result<Self, EnvError> {
        let this: Self = saved::decode_whole(bytes)?;
        if this.command != config.command {
            return Err(EnvError::State(format!(
                "it is of the world `{}`, and this is `{}`: give the command as it was",
                this.command, config.command
            )));
        }
        saved::check_copies(this.copies, num_envs)?;
        let shape = [config.height, config.width, config.channels];
        saved::check(
            this.shape == shape && this.actions == config.actions,
            "the shape of its frames or its actions",
        )?;
        let frame_bytes = num_envs * config.frame_shape().bytes();
        saved::check(this.frames.len() == frame_bytes, "the number of its frames")?;
        Ok(this)
    }
}
