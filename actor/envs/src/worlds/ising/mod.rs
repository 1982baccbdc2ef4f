//! The Ising model: a Metropolis sampler on a small lattice, and the world made of one in a field of noise.
//! It measures no mutual information and draws no score maps; the Ising experiment does.

mod lattice;
#[cfg(test)]
mod lattice_tests;
mod world;

pub use lattice::Boundary;
pub(crate) use lattice::{IsingLattice, check_temperature, neighbours_of};
#[cfg(test)]
pub(crate) use world::tests;
pub use world::{IsingConfig, IsingWorld};
