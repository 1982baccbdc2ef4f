//! The heads on the torso: C51's distribution of returns, and DIM's vectors that are compared.

pub(crate) mod acting;
pub(crate) mod c51;
pub(crate) mod config;
pub(crate) mod dim;
pub(crate) mod noise;
pub(crate) mod streams;
