//! Starting, watching and ending a run on this machine, and what it leaves in its folder.
//! It draws nothing and compares no runs.

#![cfg_attr(test, allow(clippy::unwrap_used))]

pub mod child;
pub mod console;
pub mod display;
pub mod endpoint;
pub mod evaluate;
pub mod interrupts;
pub mod lockstep;
pub mod meeting;
pub mod panics;
pub mod part_log;
pub mod plan;
pub mod processes;
mod rates;
pub mod resume;
pub mod run_folder;
pub mod shared_memory;
pub mod statuses;
