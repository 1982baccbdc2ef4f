//! Experiments that are sweeps. Each has settings in a TOML file, a page template, and Rust code for its special parts.

pub(crate) mod pacman;
pub(crate) mod procgen;
mod published;
pub(crate) mod tradeoff;
