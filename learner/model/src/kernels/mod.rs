//! What the network is computed with: this project's kernels for the CPU, and the same from candle's operations for the rest.

pub(crate) mod buffer;
pub(crate) mod candle;
pub(crate) mod conv;
pub(crate) mod convolution;
pub(crate) mod linear;
pub(crate) mod precision;
pub(crate) mod product;
pub(crate) mod rounding;
pub(crate) mod stack;
pub(crate) mod units;
