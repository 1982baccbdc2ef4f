//! Experiments that are not made of runs: each trains a small network by itself, and keeps its pieces in the cache.

mod dim;
pub(crate) mod ising;
pub(crate) mod random_walk;
