//! From a loss to new parameters: gradients and their clipping, Adam, and the slow copies that follow.

pub mod adam;
pub mod gradients;
pub mod target;
