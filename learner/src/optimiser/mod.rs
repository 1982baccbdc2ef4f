//! From a loss to new parameters: gradients and their clipping, Adam, and the slow copies of the online network.

pub mod adam;
pub mod gradients;
pub mod target;
