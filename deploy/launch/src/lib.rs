//! Starts, watches and ends a run on this machine, and writes and reads the files in its folder.
//!
//! Start with [`launcher::run`], which trains with replay servers, learner and actors as processes. [`lockstep::run`] runs all of
//! them in this process and in a fixed order. [`run_folder::RunFolder`] knows the names of a run's files:
//!
//! ```
//! use driml_launch::run_folder::{RunFolder, Summary, read_progress};
//!
//! let folder = RunFolder::new("runs/chain-c51-seed1");
//! assert!(folder.metrics().ends_with("chain-c51-seed1/metrics.csv"));
//! if Summary::is_finished(&folder) {
//!     println!("{}", Summary::read(&folder)?.describe(&folder));
//! } else if let Some(so_far) = read_progress(&folder) {
//!     println!("{} frames, {} episodes", so_far.frames, so_far.episodes);
//! }
//! # Ok::<(), anyhow::Error>(())
//! ```
//!
//! This crate compares no runs. It draws only the images among a run's events: `driml-experiments` draws figures.

#![cfg_attr(test, allow(clippy::unwrap_used))]

pub mod checkpoint_choice;
pub mod console;
pub mod endpoint;
pub mod evaluate;
pub mod evaluator;
pub mod inspect;
mod last_play;
pub mod launcher;
pub mod lockstep;
pub mod managed_process;
pub mod metrics;
pub mod open_files;
pub mod output;
pub mod panics;
pub mod plan;
pub mod pretrained;
mod process_log;
pub mod rendezvous;
pub mod resume;
pub mod run_folder;
pub mod run_view;
pub mod shared_memory;
pub mod stats;
#[cfg(test)]
mod testing;
pub mod view;
pub mod watch;
