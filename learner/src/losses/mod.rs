//! The losses: each a pure function on slices that gives value and gradient, and the candle operation around it.
//! They do not know networks, batches or which of them a run uses.

pub mod c51;
mod candle;
pub mod info_nce;
pub mod projection;
mod scalar_op;
pub mod scores;
