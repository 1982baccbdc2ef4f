//! What the network is computed with: this project's kernels for the CPU, and the same from candle's operations for the rest.

pub(crate) mod candle;
pub(crate) mod conv;
pub(crate) mod gemm;
pub(crate) mod im2col;
pub(crate) mod linear;
pub(crate) mod stack;
