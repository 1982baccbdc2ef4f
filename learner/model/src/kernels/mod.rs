//! The kernels of the network: this project's own for the CPU, and compositions of candle's operations for other devices.
//!
//! From the outside in: [`torso`], [`conv`], [`impala`], [`linear`], [`grouped`], [`residual`] and [`dots`] are operations with
//! gradients. [`operation`] turns them into candle's. These operations split their work over the rayon pool, and images into
//! [`tasks`]. [`convolution`] computes a layer of [`conv`], [`bordered`] and [`pool`] those of [`impala`]. [`product`] computes a
//! matrix product, [`dense`] an actor's linear layer. All of them use operands from [`panels`] and tiles for an instruction set
//! of [`isa`], where all unsafe code of the crate is. [`rounding`] rounds operands, [`exponentials`] computes what losses need,
//! [`buffer`] recycles memory, [`tensors`] reads candle's tensors, and [`precision`] is the setting. [`candle`] needs none of
//! these modules.

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
pub(crate) mod tasks;
pub(crate) mod tensors;
pub(crate) mod torso;
