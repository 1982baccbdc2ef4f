//! What the network is computed with: this project's kernels for the CPU, and the same from candle's operations for the rest.
//!
//! From the outside in: [`torso`], [`conv`], [`impala`], [`linear`], [`grouped`], [`residual`] and [`dots`] are operations with
//! gradients, which [`operation`] makes candle's and which split their work over the rayon pool, images into [`tasks`].
//! [`stack`] takes a task's images through all convolutions, [`convolution`] computes one of them; for an IMPALA torso [`stages`] does,
//! with [`bordered`] and [`pool`]. [`product`] computes a matrix product, [`dense`] an actor's linear layer. All work on operands of
//! [`panels`] and in tiles for an instruction set of [`isa`] with the type that it multiplies; all unsafe code of the crate is there.
//! [`rounding`] makes operands, [`exponentials`] what losses are made of, [`buffer`] keeps memory, [`tensors`] reads candle's,
//! [`precision`] is the setting. [`candle`] needs none of them.

pub(crate) mod bordered;
pub(crate) mod buffer;
pub(crate) mod candle;
pub(crate) mod conv;
pub(crate) mod convolution;
pub(crate) mod dense;
pub(crate) mod dots;
pub(crate) mod exponentials;
pub(crate) mod grouped;
pub(crate) mod images;
pub(crate) mod impala;
pub(crate) mod isa;
pub(crate) mod linear;
pub(crate) mod operation;
pub(crate) mod panels;
pub(crate) mod pool;
pub(crate) mod precision;
pub(crate) mod product;
mod reference;
pub(crate) mod residual;
pub(crate) mod rounding;
pub(crate) mod stack;
pub(crate) mod stages;
pub(crate) mod tasks;
pub(crate) mod tensors;
pub(crate) mod torso;
