//! Starting, watching and ending a run on this machine, and what it leaves in its folder.
//! It draws nothing and compares no runs.

#![cfg_attr(test, allow(clippy::unwrap_used))]

pub mod console;
pub mod endpoint;
pub mod evaluate;
pub mod interrupts;
pub mod launcher;
pub mod live_view;
pub mod lockstep;
pub mod managed_process;
pub mod meeting;
pub mod panics;
pub mod plan;
pub mod process_log;
mod rates;
pub mod resume;
pub mod run_folder;
pub mod shared_memory;
pub mod status_client;
