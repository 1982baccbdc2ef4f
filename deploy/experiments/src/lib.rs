//! `driml experiment` and `driml plot`: the paper's experiments, each a folder here, each leaving figures, data and a page.
//!
//! An experiment is a grid of pieces (a setting and a seed, say). `session::Session` keeps each finished piece, so that one
//! that was stopped goes on where it was; pieces that are whole runs are made by `queue`. What it leaves is written by
//! `page::Page` from the template `page.md` beside its settings.
//!
//! A new one is a folder with `run(args)`, a variant of [`flags::ExperimentCommand`], and beside its code `config.toml`,
//! `smoke.toml` (the same in seconds) and `page.md`. Results that are kept are in `deploy/experiments/results/`.
//!
//! Start with [`run`]; what it takes comes from a command line, here the one of Fig. 1 in its short form:
//!
//! ```no_run
//! use clap::Parser;
//! use driml_experiments::flags::ExperimentCommand;
//!
//! #[derive(Parser)]
//! struct CommandLine {
//!     #[command(subcommand)]
//!     experiment: ExperimentCommand,
//! }
//!
//! let line = CommandLine::parse_from(["driml", "random-walk", "--smoke", "--out", "walk"]);
//! driml_experiments::run(&line.experiment)?; // Leaves walk/README.md with its figures and data.
//! # Ok::<(), anyhow::Error>(())
//! ```

#![cfg_attr(test, allow(clippy::unwrap_used))]

mod aggregate;
pub mod flags;
mod grid;
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
mod runs;
mod session;
mod stability;
mod statistics;
mod template;
mod tradeoff;

use crate::flags::{ExperimentCommand, GridArgs, TradeoffArgs};

/// Runs the experiment that the command names.
///
/// # Errors
/// A folder of other settings, a file system that refuses, an interrupt; a promise of a routine that is not kept.
pub fn run(command: &ExperimentCommand) -> anyhow::Result<()> {
    match command {
        ExperimentCommand::RandomWalk(flags) => random_walk::run(flags),
        ExperimentCommand::Ising(flags) => ising::run(flags),
        ExperimentCommand::Pacman(args) => pacman::run(args),
        ExperimentCommand::Procgen(args) => procgen::run(args),
        ExperimentCommand::Stability(flags) => stability::run(flags),
    }
}

/// Measures what each dial that buys speed costs.
///
/// # Errors
/// As [`run`].
pub fn tradeoff(args: &TradeoffArgs) -> anyhow::Result<()> {
    tradeoff::run(args)
}

/// Makes a run for each combination of settings and each seed.
///
/// # Errors
/// As [`run`].
pub fn grid(args: &GridArgs) -> anyhow::Result<()> {
    grid::run(args)
}
