//! The losses: each is a pure function on slices that computes value and gradient, with a candle operation around it.
//! They know neither networks nor batches, nor which of them a run uses.

pub mod c51;
pub mod info_nce;
pub mod projection;
mod scalar_op;
pub mod scores;
