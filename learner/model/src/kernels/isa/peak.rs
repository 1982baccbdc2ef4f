//! The peak multiplication rate of a processor: one tile whose operands stay in the L1 cache, over and over.
//! Benchmarks compare the kernels with this rate. The product itself is not used.

use rayon::prelude::*;

use super::{
    dispatch::{AnySimd, with_simd},
    element::Element,
    simd::{LANES, Mode, Simd},
    tile::{LeftOperand, OutputTile, multiply_tile},
};
use crate::kernels::buffer::Buffer;
use crate::kernels::precision::Precision;

/// Scalars along the reduction axis. A panel one register wide then takes 16 KiB in f32.
const DEPTH: usize = 256;

/// Multiplies the tallest tile that is one register wide `times` times on every thread of the pool. Returns the FLOPs of all of them.
pub fn multiply_in_first_cache(precision: Precision, times: usize) -> f64 {
    with_simd!(AnySimd::fastest(precision), simd => multiply(simd, times))
}

fn multiply<S: Simd>(simd: S, times: usize) -> f64 {
    let rows = S::rows_max(1);
    let threads = rayon::current_num_threads();
    (0..threads).into_par_iter().with_max_len(1).for_each(|_| {
        let ones = |len| {
            let mut ones = Buffer::new(len);
            ones.fill(S::Element::rounded(1.0));
            ones
        };
        let (left, panel) = (ones(rows * DEPTH), ones(DEPTH * LANES));
        let mut out = Buffer::zeros(rows * LANES);
        for _ in 0..times {
            let left = LeftOperand::rows(&left, DEPTH);
            let output = OutputTile {
                out: &mut out,
                row_stride: LANES,
                cols: LANES,
                vecs: 1,
                mode: Mode::Replace,
            };
            multiply_tile(simd, rows, left, &panel, output);
        }
        assert!(
            out.iter().all(|&sum| sum == DEPTH as f32),
            "sums of products of ones are {:?}",
            &*out
        );
    });
    2.0 * (threads * times * rows * LANES * DEPTH) as f64
}

#[cfg(test)]
mod tests {
    use super::*;

    fn rows_of<S: Simd>(_: S) -> usize {
        S::rows_max(1)
    }

    #[test]
    fn every_instruction_set_sums_the_tile_that_is_counted() {
        for simd in Precision::ALL.into_iter().flat_map(AnySimd::all_available) {
            let (thrice, rows) = with_simd!(simd, simd => (multiply(simd, 3), rows_of(simd)));
            let products = 3 * rayon::current_num_threads() * rows * LANES * DEPTH;
            assert_eq!(thrice, 2.0 * products as f64);
        }
    }
}
