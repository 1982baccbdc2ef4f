//! `driml experiment`: the paper's experiments, each a folder here, each leaving figures, data and a page.
//! A new one is a folder with `run(flags)`, a command in `cli`, and settings beside its code.
//!
//! An experiment is a grid of pieces (a setting and a seed, say). [`Session`] keeps each finished piece, so one that was
//! stopped goes on where it was; [`Page`] is the README that it leaves.

#![cfg_attr(test, allow(clippy::unwrap_used))]

mod aggregate;
pub mod flags;
mod ising;
#[cfg(test)]
mod made_up;
mod pacman;
mod page;
pub mod plot;
mod procgen;
mod progress;
mod queue;
mod random_walk;
mod session;
mod statistics;

use std::path::Path;

use serde::de::DeserializeOwned;

use self::{page::Page, progress::Progress, session::Session};
use crate::flags::{ExperimentCommand, ExperimentFlags};

/// Runs one.
///
/// # Errors
/// A folder of other settings, a file system that refuses, an interrupt.
pub fn run(command: &ExperimentCommand) -> anyhow::Result<()> {
    match command {
        ExperimentCommand::RandomWalk(flags) => random_walk::run(flags),
        ExperimentCommand::Ising(flags) => ising::run(flags),
        ExperimentCommand::Pacman(args) => pacman::run(args),
        ExperimentCommand::Procgen(args) => procgen::run(args),
    }
}

/// The settings of an experiment, of its full or its smoke length; both are built in.
fn settings<T: DeserializeOwned>(
    name: &str,
    full: &str,
    smoke: &str,
    flags: &ExperimentFlags,
) -> T {
    let (file, text) = match flags.smoke {
        true => ("smoke.toml", smoke),
        false => ("config.toml", full),
    };
    toml::from_str(text).unwrap_or_else(|e| {
        panic!("experiments/{name}/{file} is built in, and a test reads it: {e}")
    })
}

/// The command that repeats an experiment, as its page has it.
fn command_line(name: &str, flags: &ExperimentFlags, out: &Path) -> String {
    let mut words = format!("driml experiment {name}");
    if flags.smoke {
        words += " --smoke";
    }
    if let Some(seeds) = flags.seeds {
        words += &format!(" --seeds {seeds}");
    }
    if flags.out.is_some() {
        words += &format!(" --out {}", out.display());
    }
    words
}
