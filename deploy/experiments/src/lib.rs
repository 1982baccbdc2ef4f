//! `driml experiment`: the paper's experiments, each a folder here, each leaving figures, data and a page.
//! A new one is a folder with `run(flags)`, a command in `cli`, and settings beside its code.
//!
//! An experiment is a grid of pieces (a setting and a seed, say). [`session::Session`] keeps each finished piece, so one that was
//! stopped goes on where it was; [`page::Page`] is the README that it leaves.

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
mod template;

use crate::flags::ExperimentCommand;

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
