//! Experiments that are sweeps: settings in a TOML file, a page template, and the Rust for what is special about each.

pub(crate) mod pacman;
pub(crate) mod procgen;
mod published;
pub(crate) mod tradeoff;
