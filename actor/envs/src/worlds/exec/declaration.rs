//! How a world's process is asked what it is.

use rand::Rng;
use tracing::Level;

use super::config::{ExecConfig, start_patience};
use super::process::{Patience, WorldProcess};
use super::protocol::{Declaration, Request};
use crate::copies::{RngUse, copy_rng};
use crate::error::{EnvError, ExecError};

/// Starts a world's process, asks it for a copy for each of `seeds`, and reads its declaration. Its stderr is logged at `level`.
pub(super) fn introduce(
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

/// Asks a command what world it is: starts it with one copy, reads its declaration, ends it.
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
pub(super) fn seeds(seed: u64, copies: usize) -> Vec<u32> {
    (0..copies)
        .map(|copy| copy_rng(seed, copy, RngUse::Game).random::<u32>() >> 1)
        .collect()
}
