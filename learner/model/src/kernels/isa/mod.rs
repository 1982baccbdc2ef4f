//! The instruction sets that products can run on, and the choice among them at run time.
//! It knows neither matrices nor layers: an instruction set computes one tile, a few rows by a few columns, in registers.

mod amx;
mod amx_tiles;
mod avx2;
mod avx512;
mod avx512_rounding;
pub(crate) mod dispatch;
pub(crate) mod element;
mod emulated;
mod peak;
mod portable;
pub(crate) mod simd;
mod tile;
mod vector;

pub(crate) use dispatch::{AnySimd, with_simd};
pub use dispatch::{describe_kernels, is_bf16_fast};
pub(crate) use element::Element;
pub use peak::multiply_in_first_cache;
pub(crate) use simd::{LANES, Mode, Simd, each_block, vectorized};
pub(crate) use tile::{LeftOperand, OutputTile, multiply_tile, row_tiles, tile_vecs};
