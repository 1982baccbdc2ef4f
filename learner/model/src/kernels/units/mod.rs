//! What a processor multiplies with: the instruction sets that products can run on, and the choice among them at run time.
//! It knows neither matrices nor layers: a unit computes one tile, a few rows by a few columns, in registers.

mod amx;
mod amx_permission;
mod avx2;
mod avx512;
mod avx512_rounding;
pub(crate) mod choice;
pub(crate) mod element;
mod emulated;
mod plain;
mod tile;
pub(crate) mod unit;
mod vector;

pub(crate) use choice::{AnyUnit, on_unit};
pub use choice::{is_bf16_fast, kernels_in_words};
pub(crate) use element::Element;
pub(crate) use tile::{Columns, Left, multiply_tile, row_tiles, tile_vecs};
pub(crate) use unit::{LANES, Mode, Unit, vectorized};
