//! The heads on the torso: C51 for return distributions, and DIM for the vectors that are compared.

pub(crate) mod c51;
pub(crate) mod config;
pub(crate) mod dim;
pub(crate) mod noise;
pub(crate) mod streams;
