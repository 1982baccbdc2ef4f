//! The settings of a run: presets in layers, flags over them, what the machine decides, what follows from the rest.
//! It starts nothing and writes no file.

#![cfg_attr(test, allow(clippy::unwrap_used))]

pub mod config;
mod derived;
pub mod flags;
pub mod menu;
mod overrides;
pub mod presets;
