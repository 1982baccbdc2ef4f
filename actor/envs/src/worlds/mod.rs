//! The worlds, a folder or a file each. A line in `registry` registers each world.

pub(crate) mod chain;
pub(crate) mod exec;
pub(crate) mod ising;
pub(crate) mod pacman;
pub(crate) mod procgen;
