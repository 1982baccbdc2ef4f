//! The worlds, a folder or a file each. What makes one of them known is a line in `registry`.

pub(crate) mod chain;
pub(crate) mod exec;
pub(crate) mod ising;
pub(crate) mod pacman;
pub(crate) mod procgen;
