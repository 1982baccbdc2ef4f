//! The choice among the units at run time, by what the processor offers.

use super::plain;
use super::unit::ForUnit;
#[cfg(target_arch = "x86_64")]
use super::{amx, avx2, avx512};
use crate::kernels::precision::Precision;

/// Instructions that units are made of, the best first.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
enum Instructions {
    Plain,
    Avx2,
    Avx512,
    Avx512Bf16,
    Amx,
}

fn instructions() -> Instructions {
    #[cfg(target_arch = "x86_64")]
    {
        if avx512::available() {
            if amx::available() {
                return Instructions::Amx;
            }
            return if avx512::Brain::available() {
                Instructions::Avx512Bf16
            } else {
                Instructions::Avx512
            };
        }
        if avx2::available() {
            return Instructions::Avx2;
        }
    }
    Instructions::Plain
}

/// Does `work` on the fastest unit that this processor has for `precision`.
pub(crate) fn with_unit<F: ForUnit>(precision: Precision, work: F) -> F::Output {
    with_unit_of(instructions(), precision, work)
}

#[cfg(target_arch = "x86_64")]
fn with_unit_of<F: ForUnit>(best: Instructions, precision: Precision, work: F) -> F::Output {
    use Instructions::{Amx, Avx2, Avx512, Avx512Bf16, Plain};
    match (precision, best) {
        (Precision::F32, Avx512 | Avx512Bf16 | Amx) => work.run(avx512::Single::here()),
        (Precision::F32, Avx2) => work.run(avx2::Single::here()),
        (Precision::F32, Plain) => work.run(plain::Single),
        (Precision::Bf16, Amx) => work.run(amx::Amx::here()),
        (Precision::Bf16, Avx512Bf16) => work.run(avx512::Brain::here()),
        (Precision::Bf16, Avx2 | Avx512) => work.run(avx2::Rounded::here()),
        (Precision::Bf16, Plain) => work.run(plain::Rounded),
    }
}

#[cfg(not(target_arch = "x86_64"))]
fn with_unit_of<F: ForUnit>(_: Instructions, precision: Precision, work: F) -> F::Output {
    match precision {
        Precision::F32 => work.run(plain::Single),
        Precision::Bf16 => work.run(plain::Rounded),
    }
}

/// Whether this processor multiplies faster in bf16 than in f32: it has AVX512_BF16 or AMX.
pub fn is_bf16_fast() -> bool {
    instructions() >= Instructions::Avx512Bf16
}

/// What products of this precision run on here, in words: for `driml doctor` and the head of a table of figures.
pub fn kernels_in_words(precision: Precision) -> &'static str {
    match (precision, instructions()) {
        (Precision::F32, Instructions::Avx512 | Instructions::Avx512Bf16 | Instructions::Amx) => {
            "AVX-512, f32"
        }
        (Precision::F32, Instructions::Avx2) => "AVX2, f32",
        (Precision::F32, Instructions::Plain) => "portable code, f32",
        (Precision::Bf16, Instructions::Amx) => "AMX: bf16 products, f32 sums",
        (Precision::Bf16, Instructions::Avx512Bf16) => "AVX512_BF16: bf16 products, f32 sums",
        (Precision::Bf16, Instructions::Avx2 | Instructions::Avx512) => {
            "AVX2 on operands rounded to bf16: no faster than f32"
        }
        (Precision::Bf16, Instructions::Plain) => {
            "portable code on operands rounded to bf16: no faster than f32"
        }
    }
}

/// Does `work` on every unit that can be had here, the emulated one included, and collects what it gives.
#[cfg(test)]
pub(crate) fn with_every_unit<F: ForUnit + Copy>(precision: Precision, work: F) -> Vec<F::Output> {
    let all = [
        Instructions::Plain,
        Instructions::Avx2,
        Instructions::Avx512,
        Instructions::Avx512Bf16,
        Instructions::Amx,
    ];
    let there = all.into_iter().filter(|&best| best <= instructions());
    #[allow(unused_mut, reason = "there is no emulated unit elsewhere")]
    let mut results: Vec<_> = there
        .map(|best| with_unit_of(best, precision, work))
        .collect();
    #[cfg(target_arch = "x86_64")]
    if precision == Precision::Bf16 {
        results.push(work.run(super::emulated::EmulatedAmx));
    }
    results
}

#[cfg(test)]
mod tests {
    use half::bf16;

    use super::*;
    use crate::kernels::units::{Columns, Element, LANES, Left, Mode, Unit, multiply_tile};

    #[derive(Clone, Copy)]
    struct Product<'a> {
        rows: usize,
        vecs: usize,
        cols: usize,
        mode: Mode,
        left: &'a [f32],
        right: &'a [f32],
        steps: usize,
        /// Whether a row's steps lie apart, and the rows side by side.
        rows_inside: bool,
    }

    impl ForUnit for Product<'_> {
        type Output = Option<Vec<f32>>;

        /// [rows, cols] of ones plus, or else, the product; `None` if the unit has no such tile.
        fn run<U: Unit>(self, unit: U) -> Option<Vec<f32>> {
            if self.vecs > U::VECS_MAX || self.rows > U::rows_max(self.vecs) {
                return None;
            }
            let depth = U::Element::DEPTH;
            let (k, width) = (self.steps * depth, self.vecs * LANES);
            // Two runs of `k` terms a row, all in one piece.
            let (row_stride, step, run_stride) = if self.rows_inside {
                (depth, depth * self.rows, self.rows * k)
            } else {
                (2 * k, depth, k)
            };
            let left: Vec<_> = (0..self.rows * 2 * k)
                .map(|at| U::Element::of(self.left[at % self.left.len()]))
                .collect();
            let mut panel = vec![U::Element::default(); 2 * k * width];
            for (at, value) in panel.iter_mut().enumerate() {
                *value = U::Element::of(self.right[at % self.right.len()]);
            }
            let mut out = vec![1.0; self.rows * (self.cols + 3)];
            multiply_tile(
                unit,
                self.rows,
                Left {
                    values: &left,
                    start: 0,
                    row_stride,
                    step,
                    steps: self.steps,
                    run_stride,
                    runs: 2,
                },
                &panel,
                Columns {
                    out: &mut out,
                    stride: self.cols + 3,
                    cols: self.cols,
                    vecs: self.vecs,
                    mode: self.mode,
                },
            );
            for row in 0..self.rows {
                for col in 0..self.cols + 3 {
                    let got = out[row * (self.cols + 3) + col];
                    let wanted = if col < self.cols {
                        let start = if self.mode == Mode::Add { 1.0 } else { 0.0 };
                        (0..2 * k).fold(start, |sum, k_at| {
                            let (at_step, part) = (k_at / depth, k_at % depth);
                            let right = panel[(at_step * width + col) * depth + part].value();
                            let left_at = row * row_stride
                                + at_step / self.steps * run_stride
                                + at_step % self.steps * step
                                + part;
                            sum + f64::from(left[left_at].value()) * f64::from(right)
                        })
                    } else {
                        1.0
                    };
                    assert!(
                        (f64::from(got) - wanted).abs() <= 1e-5 * (1.0 + wanted.abs()),
                        "row {row}, column {col}: {got}, wanted {wanted}"
                    );
                }
            }
            Some(out)
        }
    }

    #[test]
    fn every_unit_computes_every_size_of_tile() {
        let left: Vec<f32> = (0..97).map(|i| (i * 37 % 41) as f32 / 8.0 - 2.5).collect();
        let right: Vec<f32> = (0..89).map(|i| (i * 29 % 31) as f32 / 8.0 - 1.9).collect();
        let mut tried = 0;
        let sizes = [1, 2, 4].into_iter().flat_map(|vecs| {
            (1..=8)
                .chain([16, 17, 40, 64])
                .map(move |rows| (vecs, rows))
        });
        for ((vecs, rows), rows_inside) in sizes.flat_map(|size| [(size, false), (size, true)]) {
            for (cols, mode, steps) in [
                (vecs * LANES, Mode::Replace, 5),
                (vecs * LANES - 5, Mode::Add, 1),
                ((vecs - 1) * LANES + 1, Mode::Add, 16),
                (vecs * LANES, Mode::Replace, 35),
            ] {
                let product = Product {
                    rows,
                    vecs,
                    cols,
                    mode,
                    left: &left,
                    right: &right,
                    steps,
                    rows_inside,
                };
                for precision in Precision::ALL {
                    tried += with_every_unit(precision, product)
                        .into_iter()
                        .flatten()
                        .count();
                }
            }
        }
        assert!(tried >= 2 * 3 * 4, "{tried} tiles");
    }

    #[test]
    fn every_unit_transposes_a_block() {
        #[derive(Clone, Copy)]
        struct Transpose;
        impl ForUnit for Transpose {
            type Output = ();
            fn run<U: Unit>(self, unit: U) {
                let number = |row: usize, col: usize| (row * 100 + col) as u32;
                let mut block: [[u32; LANES]; LANES] =
                    std::array::from_fn(|row| std::array::from_fn(|col| number(row, col)));
                unit.transpose(&mut block);
                for (row, block) in block.iter().enumerate() {
                    for (col, &got) in block.iter().enumerate() {
                        assert_eq!(got, number(col, row));
                    }
                }
            }
        }
        for precision in Precision::ALL {
            assert!(!with_every_unit(precision, Transpose).is_empty());
        }
    }

    /// Lengths that fill no register; values over the whole of the float space, subnormals and what is not finite included.
    #[test]
    fn every_unit_rounds_to_the_nearest() {
        #[derive(Clone, Copy)]
        struct Round<'a>(&'a [f32], &'a [f32]);
        impl ForUnit for Round<'_> {
            type Output = [Vec<bf16>; 2];
            fn run<U: Unit>(self, unit: U) -> [Vec<bf16>; 2] {
                let Self(first, second) = self;
                // What lies beyond is left alone.
                let mut rounded = vec![bf16::ONE; first.len() + 3];
                unit.round(first, &mut rounded);
                let mut pairs = vec![bf16::ONE; 2 * first.len() + 3];
                unit.round_pairs(first, second, &mut pairs);
                [rounded, pairs]
            }
        }
        let mut bits = 1u32;
        let mut draw = |_| {
            bits = bits.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            f32::from_bits(bits)
        };
        let check = |got: bf16, value: f32| {
            let (got, wanted) = (got.to_f32(), bf16::from_f32(value).to_f32());
            let subnormal = value.abs() < f32::MIN_POSITIVE && got == 0.0;
            assert!(
                got.to_bits() == wanted.to_bits()
                    || value.is_nan() && got.is_nan()
                    || subnormal && got.is_sign_negative() == value.is_sign_negative(),
                "{value:e}: {got:e}, wanted {wanted:e}"
            );
        };
        for len in (0..70).chain([100_000]) {
            let first: Vec<f32> = (0..len).map(&mut draw).collect();
            let second: Vec<f32> = (0..len).map(&mut draw).collect();
            for [rounded, pairs] in with_every_unit(Precision::Bf16, Round(&first, &second)) {
                for (at, (&first, &second)) in first.iter().zip(&second).enumerate() {
                    check(rounded[at], first);
                    check(pairs[2 * at], first);
                    check(pairs[2 * at + 1], second);
                }
                assert!(rounded[len..].iter().all(|&one| one == bf16::ONE));
                assert!(pairs[2 * len..].iter().all(|&one| one == bf16::ONE));
            }
        }
    }

    #[test]
    fn every_unit_puts_scalars_in_pairs() {
        #[derive(Clone, Copy)]
        struct Pair<'a>(&'a [u8], &'a [u8]);
        impl ForUnit for Pair<'_> {
            type Output = [Vec<bf16>; 3];
            fn run<U: Unit>(self, unit: U) -> [Vec<bf16>; 3] {
                let Self(first, second) = self;
                // What lies beyond is left alone.
                let room = |len: usize| vec![bf16::NEG_ONE; len + 3];
                let [mut bytes, mut others] = [room(first.len()), room(second.len())];
                unit.of_bytes(first, &mut bytes);
                unit.of_bytes(second, &mut others);
                let [mut pairs, mut of_bytes] = [room(2 * first.len()), room(2 * first.len())];
                let (one, other) = (&bytes[..first.len()], &others[..second.len()]);
                unit.pair(one, other, &mut pairs);
                unit.pair_bytes(first, second, &mut of_bytes);
                [bytes, pairs, of_bytes]
            }
        }
        for len in (0..140).chain([10_000]) {
            let first: Vec<u8> = (0..len).map(|at| (at * 31 % 256) as u8).collect();
            let second: Vec<u8> = (0..len).map(|at| (at * 7 % 255 + 1) as u8).collect();
            for [bytes, pairs, of_bytes] in with_every_unit(Precision::Bf16, Pair(&first, &second))
            {
                for (at, both) in first.iter().zip(&second).enumerate() {
                    let wanted = [*both.0, *both.1].map(|byte| bf16::from_f32(byte.into()));
                    assert_eq!(bytes[at], wanted[0]);
                    assert_eq!(pairs[2 * at..][..2], wanted);
                    assert_eq!(of_bytes[2 * at..][..2], wanted);
                }
                assert_eq!(bytes[len..], [bf16::NEG_ONE; 3]);
                assert_eq!(pairs[2 * len..], [bf16::NEG_ONE; 3]);
                assert_eq!(of_bytes[2 * len..], [bf16::NEG_ONE; 3]);
            }
        }
    }

    #[test]
    fn the_kernels_of_this_processor_have_names() {
        for precision in [Precision::F32, Precision::Bf16] {
            assert!(!kernels_in_words(precision).is_empty());
        }
    }
}
