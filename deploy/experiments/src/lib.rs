//! Implements `driml experiment`, `driml sweep`, `driml tradeoff` and `driml plot`. They make runs or small trainings, and write
//! figures, data and a page.
//!
//! * `sweep` is the engine for runs: it makes, resumes and keeps the runs of every combination of settings and seed. `sweeps` has the
//!   experiments that consist of runs: for each a TOML file, a page template and its special code.
//! * `studies` has the experiments that train small networks without runs; `stability` measures the errors of numeric routines.
//! * `cache` keeps finished pieces of work in an experiment's folder, `stats` has the statistics, `page` fills in templates, `plot` draws
//!   the metrics of runs, `small` makes the smallest networks.
//!
//! A new experiment of runs needs three files in `sweeps` and a variant of [`flags::ExperimentCommand`]. Published results are in
//! `deploy/experiments/results/`.
//!
//! Start with [`run`]. Its argument comes from a command line, here the short form of the experiment of Fig. 1:
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
/// The folder was made with other settings, a file cannot be read or written, the user interrupts, or a routine breaks its promise.
pub fn run(command: &ExperimentCommand) -> anyhow::Result<()> {
    match command {
        ExperimentCommand::RandomWalk(flags) => random_walk::run(flags),
        ExperimentCommand::Ising(flags) => ising::run(flags),
        ExperimentCommand::Pacman(args) => pacman::run(args),
        ExperimentCommand::Procgen(args) => procgen::run(args),
        ExperimentCommand::Stability(flags) => stability::run(flags),
    }
}
