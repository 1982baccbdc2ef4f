//! `driml experiment`, `driml sweep`, `driml tradeoff` and `driml plot`: whatever is made of runs or of small trainings, and leaves
//! figures, data and a page.
//!
//! * `sweep` is the engine for runs: it makes, resumes and keeps those of every combination of settings and seed. `sweeps` are the
//!   experiments that consist of runs, each a TOML file, a page template and what is special about it.
//! * `studies` are the experiments that train something of their own; `stability` measures numeric routines.
//! * `cache` keeps finished pieces of work in an experiment's folder, `stats` has the statistics, `page` fills in templates, `plot` draws
//!   what runs recorded, `small` makes the smallest networks.
//!
//! A new experiment of runs is three files in `sweeps` and a variant of [`flags::ExperimentCommand`]. Results that are kept are in
//! `deploy/experiments/results/`.
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

mod cache;
pub mod flags;
mod page;
pub mod plot;
mod progress;
mod small;
mod stability;
mod stats;
mod studies;
mod sweep;
mod sweeps;

use crate::{
    flags::ExperimentCommand,
    studies::{ising, random_walk},
    sweeps::{pacman, procgen},
};
pub use crate::{sweep::command::run as sweep, sweeps::tradeoff::run as tradeoff};

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
