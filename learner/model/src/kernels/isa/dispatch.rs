//! The choice among instruction sets at run time, by what the processor offers.

use super::portable;
#[cfg(target_arch = "x86_64")]
use super::{amx, avx2, avx512};
use crate::kernels::precision::Precision;

/// An instruction set of this processor, to be used through [`with_simd`].
#[derive(Clone, Copy)]
pub(crate) enum AnySimd {
    PortableF32(portable::F32),
    PortableBf16(portable::Bf16),
    #[cfg(target_arch = "x86_64")]
    Avx2F32(avx2::F32),
    #[cfg(target_arch = "x86_64")]
    Avx2Bf16(avx2::Bf16),
    #[cfg(target_arch = "x86_64")]
    Avx512F32(avx512::F32),
    #[cfg(target_arch = "x86_64")]
    Avx512Bf16(avx512::Bf16),
    #[cfg(target_arch = "x86_64")]
    Amx(amx::Amx),
    #[cfg(all(test, target_arch = "x86_64"))]
    EmulatedAmx(super::emulated::EmulatedAmx),
}

/// `with_simd!(simd, s => expression)` evaluates the expression with `s` bound to the instruction set, of its concrete type.
macro_rules! with_simd {
    ($simd:expr, $typed:ident => $body:expr) => {
        match $simd {
            $crate::kernels::isa::dispatch::AnySimd::PortableF32($typed) => $body,
            $crate::kernels::isa::dispatch::AnySimd::PortableBf16($typed) => $body,
            #[cfg(target_arch = "x86_64")]
            $crate::kernels::isa::dispatch::AnySimd::Avx2F32($typed) => $body,
            #[cfg(target_arch = "x86_64")]
            $crate::kernels::isa::dispatch::AnySimd::Avx2Bf16($typed) => $body,
            #[cfg(target_arch = "x86_64")]
            $crate::kernels::isa::dispatch::AnySimd::Avx512F32($typed) => $body,
            #[cfg(target_arch = "x86_64")]
            $crate::kernels::isa::dispatch::AnySimd::Avx512Bf16($typed) => $body,
            #[cfg(target_arch = "x86_64")]
            $crate::kernels::isa::dispatch::AnySimd::Amx($typed) => $body,
            #[cfg(all(test, target_arch = "x86_64"))]
            $crate::kernels::isa::dispatch::AnySimd::EmulatedAmx($typed) => $body,
        }
    };
}
pub(crate) use with_simd;

/// Returns an instruction set if the processor has its instructions.
type Candidate = fn() -> Option<AnySimd>;

/// The instruction sets for each precision, fastest first. The last one runs anywhere.
const F32_CANDIDATES: &[Candidate] = &[
    #[cfg(target_arch = "x86_64")]
    || avx512::F32::new().map(AnySimd::Avx512F32),
    #[cfg(target_arch = "x86_64")]
    || avx2::F32::new().map(AnySimd::Avx2F32),
    || Some(AnySimd::PortableF32(portable::F32)),
];
const BF16_CANDIDATES: &[Candidate] = &[
    #[cfg(target_arch = "x86_64")]
    || amx::Amx::new().map(AnySimd::Amx),
    #[cfg(target_arch = "x86_64")]
    || avx512::Bf16::new().map(AnySimd::Avx512Bf16),
    #[cfg(target_arch = "x86_64")]
    || avx2::Bf16::new().map(AnySimd::Avx2Bf16),
    || Some(AnySimd::PortableBf16(portable::Bf16)),
];

impl AnySimd {
    /// Returns the fastest instruction set that this processor has for `precision`.
    pub(crate) fn fastest(precision: Precision) -> Self {
        let mut available = Self::available(precision);
        available.next().expect("portable code runs anywhere")
    }

    fn available(precision: Precision) -> impl Iterator<Item = Self> {
        let candidates = match precision {
            Precision::F32 => F32_CANDIDATES,
            Precision::Bf16 => BF16_CANDIDATES,
        };
        candidates.iter().filter_map(|candidate| candidate())
    }

    /// Returns every instruction set that runs here, including the emulated one.
    #[cfg(test)]
    pub(crate) fn all_available(precision: Precision) -> Vec<Self> {
        #[allow(unused_mut, reason = "only x86-64 has an emulated one")]
        let mut all: Vec<_> = Self::available(precision).collect();
        #[cfg(target_arch = "x86_64")]
        if precision == Precision::Bf16 {
            all.push(Self::EmulatedAmx(super::emulated::EmulatedAmx));
        }
        all
    }

    fn describe(self) -> &'static str {
        match self {
            Self::PortableF32(_) => "portable code, f32",
            Self::PortableBf16(_) => {
                "portable code on operands rounded to bf16: no faster than f32"
            }
            #[cfg(target_arch = "x86_64")]
            Self::Avx2F32(_) => "AVX2, f32",
            #[cfg(target_arch = "x86_64")]
            Self::Avx2Bf16(_) => "AVX2 on operands rounded to bf16: no faster than f32",
            #[cfg(target_arch = "x86_64")]
            Self::Avx512F32(_) => "AVX-512, f32",
            #[cfg(target_arch = "x86_64")]
            Self::Avx512Bf16(_) if avx512::is_bf16_fast() => "AVX512_BF16: bf16 products, f32 sums",
            #[cfg(target_arch = "x86_64")]
            Self::Avx512Bf16(_) => {
                "AVX512_BF16: bf16 products, f32 sums; no faster than f32 on this processor"
            }
            #[cfg(target_arch = "x86_64")]
            Self::Amx(_) => "AMX: bf16 products, f32 sums",
            #[cfg(all(test, target_arch = "x86_64"))]
            Self::EmulatedAmx(_) => "AMX, emulated",
        }
    }
}

/// Whether this processor multiplies faster in bf16 than in f32: it has AMX, or is AMD's with AVX512_BF16.
pub fn is_bf16_fast() -> bool {
    match AnySimd::fastest(Precision::Bf16) {
        #[cfg(target_arch = "x86_64")]
        AnySimd::Amx(_) => true,
        #[cfg(target_arch = "x86_64")]
        AnySimd::Avx512Bf16(_) => avx512::is_bf16_fast(),
        _ => false,
    }
}

/// Describes the instruction set for products of this precision, for `driml doctor` and the heads of tables.
pub fn describe_kernels(precision: Precision) -> &'static str {
    AnySimd::fastest(precision).describe()
}

#[cfg(test)]
mod tests {
    use half::bf16;

    use super::*;
    use crate::kernels::isa::element::Rounding;
    use crate::kernels::isa::{Element, LANES, LeftOperand, Mode, OutputTile, Simd, multiply_tile};

    #[cfg(target_arch = "x86_64")]
    #[test]
    fn avx512_bf16_is_fast_where_it_was_measured_to_be() {
        for (vendor, is_fast) in [(*b"Auth", true), (*b"Genu", false)] {
            assert_eq!(avx512::is_bf16_fast_by(vendor), is_fast, "{vendor:?}");
        }
    }

    /// Compares a tile, written or added to ones, with a plain sum. Returns whether the instruction set has this
    /// size of tile. With `rows_adjacent` the rows are adjacent and a row's steps are apart, else the reverse.
    fn check_tile<S: Simd>(
        simd: S,
        [rows, vecs]: [usize; 2],
        cols: usize,
        mode: Mode,
        steps: usize,
        rows_adjacent: bool,
    ) -> bool {
        if vecs > S::VECS_MAX || rows > S::rows_max(vecs) {
            return false;
        }
        let depth = S::Element::DEPTH;
        let (k, width) = (steps * depth, vecs * LANES);
        // Two runs of `k` terms a row.
        let (row_stride, step_stride, run_stride) = if rows_adjacent {
            (depth, depth * rows, rows * k)
        } else if rows == 1 && depth == 1 {
            // A single row has any stride: twice this one wraps to a run.
            (k / 2 + (1 << 63), depth, k)
        } else {
            (2 * k, depth, k)
        };
        let left: Vec<_> = (0..rows * 2 * k)
            .map(|at| S::Element::rounded((at % 97 * 37 % 41) as f32 / 8.0 - 2.5))
            .collect();
        let panel: Vec<_> = (0..2 * k * width)
            .map(|at| S::Element::rounded((at % 89 * 29 % 31) as f32 / 8.0 - 1.9))
            .collect();
        let stride = cols + 3;
        let mut out = vec![1.0; rows * stride];
        let operand = LeftOperand {
            values: &left,
            start: 0,
            row_stride,
            step_stride,
            steps,
            run_stride,
            runs: 2,
        };
        let output = OutputTile {
            out: &mut out,
            row_stride: stride,
            cols,
            vecs,
            mode,
        };
        multiply_tile(simd, rows, operand, &panel, output);
        for (at, &got) in out.iter().enumerate() {
            let (row, col) = (at / stride, at % stride);
            let start = if col < cols && mode == Mode::Replace {
                0.0
            } else {
                1.0
            };
            let terms = (0..2 * k).filter(|_| col < cols).map(|term| {
                let (at_step, part) = (term / depth, term % depth);
                let right = panel[(at_step * width + col) * depth + part];
                let run = at_step / steps * run_stride + at_step % steps * step_stride;
                let left = left[row * row_stride + run + part];
                f64::from(left.value()) * f64::from(right.value())
            });
            let wanted = start + terms.sum::<f64>();
            let is_close = (f64::from(got) - wanted).abs() <= 1e-5 * (1.0 + wanted.abs());
            assert!(is_close, "row {row}, column {col}: {got}, wanted {wanted}");
        }
        true
    }

    #[test]
    fn every_instruction_set_computes_every_size_of_tile() {
        let mut tried = 0;
        let heights = (1..=17).chain([40, 50, 64]);
        let sizes = [1, 2, 4].map(|vecs| heights.clone().map(move |rows| [rows, vecs]));
        for [rows, vecs] in sizes.into_iter().flatten() {
            for (cols, mode, steps) in [
                (vecs * LANES, Mode::Replace, 5),
                (vecs * LANES - 5, Mode::Add, 1),
                ((vecs - 1) * LANES + 1, Mode::Add, 16),
                (vecs * LANES, Mode::Replace, 35),
            ] {
                for simd in Precision::ALL.into_iter().flat_map(AnySimd::all_available) {
                    for rows_adjacent in [false, true] {
                        let is_supported = with_simd!(simd, simd => {
                            check_tile(simd, [rows, vecs], cols, mode, steps, rows_adjacent)
                        });
                        tried += usize::from(is_supported);
                    }
                }
            }
        }
        // Portable code alone has four sizes.
        assert!(tried >= 4 * 4 * 2 * 2, "{tried} tiles");
    }

    /// Lengths that do not fill registers; values from the whole range of f32, including subnormals, infinities and NaN.
    #[test]
    fn every_instruction_set_rounds_to_the_nearest_and_puts_scalars_in_pairs() {
        let nearest = |value: f32| bf16::from_f32(value).to_f32();
        let check = |got: bf16, value: f32| {
            let (got, wanted) = (got.to_f32(), nearest(value));
            let subnormal = value.abs() < f32::MIN_POSITIVE && got == 0.0;
            assert!(
                got.to_bits() == wanted.to_bits()
                    || value.is_nan() && got.is_nan()
                    || subnormal && got.is_sign_negative() == value.is_sign_negative(),
                "{value:e}: {got:e}, wanted {wanted:e}"
            );
        };
        let nans = [0x7f80_0001, 0xffff_ffff].map(f32::from_bits);
        let special = [0.0, -0.0, f32::MAX, f32::INFINITY, f32::NEG_INFINITY, 1e-45];
        let special = nans.into_iter().chain(special);
        let mut bits = 1u32;
        // A full-period walk over the float space.
        let mut walk = std::iter::from_fn(|| {
            bits = bits.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            Some(f32::from_bits(bits))
        });
        for value in special.clone().chain(walk.by_ref().take(1_000_000)) {
            // Subnormals are exact too.
            let (got, wanted) = (bf16::rounded(value).to_f32(), nearest(value));
            let is_nearest = got.to_bits() == wanted.to_bits();
            let is_nan = got.is_nan() && value.is_nan();
            assert!(is_nearest || is_nan, "{value:e}: {got:e}");
        }
        for byte in 0..=255 {
            assert_eq!(f32::from_byte(byte), f32::from(byte) * (1.0 / 255.0));
        }
        for len in (0..140).chain([100_000]) {
            let first: Vec<_> = special.clone().chain(walk.by_ref()).take(len).collect();
            let special = special.clone().rev();
            let second: Vec<_> = special.chain(walk.by_ref()).take(len).collect();
            let bytes = |by: usize| (0..len).map(move |at| (at * by % 256) as u8);
            let [first_bytes, second_bytes] = [31, 7].map(|by| bytes(by).collect::<Vec<_>>());
            for simd in AnySimd::all_available(Precision::Bf16) {
                // Elements beyond the results must not change.
                let [mut rounded, mut of_first, mut of_second] =
                    [(); 3].map(|()| vec![bf16::NEG_ONE; len + 3]);
                let [mut pairs, mut joined] = [(); 2].map(|()| vec![bf16::NEG_ONE; 2 * len + 3]);
                with_simd!(simd, simd => {
                    simd.round(&first, &mut rounded);
                    simd.round_pairs(&first, &second, &mut pairs);
                    simd.convert_bytes(&first_bytes, &mut of_first);
                    simd.convert_bytes(&second_bytes, &mut of_second);
                    simd.pair(&of_first[..len], &of_second[..len], &mut joined);
                });
                for (at, (&first, &second)) in first.iter().zip(&second).enumerate() {
                    check(rounded[at], first);
                    check(pairs[2 * at], first);
                    check(pairs[2 * at + 1], second);
                    let exact =
                        [first_bytes[at], second_bytes[at]].map(|it| bf16::from_f32(it.into()));
                    assert_eq!(of_first[at], exact[0]);
                    assert_eq!(joined[2 * at..][..2], exact);
                }
                for single in [rounded, of_first, of_second] {
                    assert_eq!(single[len..], [bf16::NEG_ONE; 3]);
                }
                for double in [pairs, joined] {
                    assert_eq!(double[2 * len..], [bf16::NEG_ONE; 3]);
                }
            }
        }
    }
}
