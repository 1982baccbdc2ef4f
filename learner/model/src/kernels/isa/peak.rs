//! The peak multiplication rate of a processor: its largest tile, whose operands stay in the L1 cache, over and over.
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

/// The size of the right operand, which fits into the L1 cache of every processor.
const PANEL_BYTES: usize = 24 << 10;

/// Multiplies the widest tile, as tall as it may be, `times` times on every thread of the pool. Returns the FLOPs of all of them.
pub fn multiply_in_first_cache(precision: Precision, times: usize) -> f64 {
    with_simd!(AnySimd::fastest(precision), simd => multiply(simd, times))
}

fn multiply<S: Simd>(simd: S, times: usize) -> f64 {
    let (vecs, rows) = (S::VECS_MAX, S::rows_max(S::VECS_MAX));
    let cols = vecs * LANES;
    let depth = PANEL_BYTES / (cols * size_of::<S::Element>());
    let threads = rayon::current_num_threads();
    (0..threads).into_par_iter().with_max_len(1).for_each(|_| {
        let ones = |len| {
            let mut ones = Buffer::new(len);
            ones.fill(S::Element::rounded(1.0));
            ones
        };
        let (left, panel) = (ones(rows * depth), ones(depth * cols));
        let mut out = Buffer::zeros(rows * cols);
        for _ in 0..times {
            let left = LeftOperand::rows(&left, depth);
            let output = OutputTile {
                out: &mut out,
                row_stride: cols,
                cols,
                vecs,
                mode: Mode::Replace,
            };
            multiply_tile(simd, rows, left, &panel, output);
        }
        let is_right = out.iter().all(|&sum| sum == depth as f32);
        assert!(is_right, "sums of products of ones are {:?}", &*out);
    });
    2.0 * (threads * times * rows * cols * depth) as f64
}

#[cfg(test)]
mod tests {
    use super::*;

    fn products_of<S: Simd>(_: S) -> usize {
        S::rows_max(S::VECS_MAX) * PANEL_BYTES / size_of::<S::Element>()
    }

    #[test]
    fn every_instruction_set_sums_the_tile_that_is_counted() {
        for simd in Precision::ALL.into_iter().flat_map(AnySimd::all_available) {
            let (thrice, once) = with_simd!(simd, simd => (multiply(simd, 3), products_of(simd)));
            assert_eq!(thrice, (6 * rayon::current_num_threads() * once) as f64);
        }
    }
}
