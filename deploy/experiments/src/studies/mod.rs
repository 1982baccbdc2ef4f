//! Experiments without runs: each trains a small network in this process, and keeps its pieces in the cache.

mod dim;
pub(crate) mod ising;
pub(crate) mod random_walk;
