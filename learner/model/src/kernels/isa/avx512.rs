//! AVX-512: 16 f32 products an instruction, or with AVX512_BF16 32 bf16 products summed in pairs.
#![allow(unsafe_code, reason = "instructions of one kind of processor")]
#![cfg(target_arch = "x86_64")]

use std::arch::x86_64::{
    __cpuid, __m256, __m256bh, __m256i, __m512, __m512bh, __m512i, _mm256_add_ps, _mm256_dpbf16_ps,
    _mm256_fmadd_ps, _mm256_loadu_ps, _mm256_loadu_si256, _mm256_mask_storeu_ps,
    _mm256_maskz_loadu_ps, _mm256_set1_epi32, _mm256_set1_ps, _mm512_add_ps, _mm512_dpbf16_ps,
    _mm512_fmadd_ps, _mm512_loadu_ps, _mm512_loadu_si512, _mm512_mask_storeu_ps,
    _mm512_maskz_loadu_ps, _mm512_set1_epi32, _mm512_set1_ps, _mm512_shuffle_i32x4,
    _mm512_storeu_si512, _mm512_unpackhi_epi32, _mm512_unpackhi_epi64, _mm512_unpacklo_epi32,
    _mm512_unpacklo_epi64,
};
use std::mem::transmute;

use half::bf16;

use super::{
    avx512_rounding::{self, first_lanes},
    element::Rounding,
    simd::{LANES, Loop, RawTile, Simd},
    vector::{Sums, Vector, compute_sizes},
};

/// Whether the processor and the operating system have the AVX-512 extensions of server processors.
fn has_avx512() -> bool {
    is_x86_feature_detected!("avx512f")
        && is_x86_feature_detected!("avx512bw")
        && is_x86_feature_detected!("avx512dq")
        && is_x86_feature_detected!("avx512vl")
        && is_x86_feature_detected!("fma")
}

#[derive(Clone, Copy)]
pub(crate) struct F32(());

/// bf16 operands in pairs.
#[derive(Clone, Copy)]
pub(crate) struct Bf16(());

impl F32 {
    pub(super) fn new() -> Option<Self> {
        has_avx512().then_some(Self(()))
    }
}

impl Bf16 {
    /// Returns the instruction set if the processor has AVX512_BF16 in addition to AVX-512.
    pub(super) fn new() -> Option<Self> {
        (has_avx512() && is_x86_feature_detected!("avx512bf16")).then_some(Self(()))
    }
}

/// Whether bf16's instruction multiplies faster than f32's. On AMD's Zen 4 the peak is 430 GFLOP/s against 221, on Intel's
/// family 6, model 207 without AMX 150 against 257 (`driml bench learner --kernels`, two cores each).
#[allow(
    unused_unsafe,
    reason = "the instruction is unsafe in Rust 1.90 and safe in later ones"
)]
pub(super) fn is_bf16_fast() -> bool {
    // SAFETY: every processor of this architecture has the instruction.
    let leaf_0 = unsafe { __cpuid(0) };
    is_bf16_fast_by(leaf_0.ebx.to_le_bytes())
}

/// The same, by the first letters of the processor's vendor: AMD's is `AuthenticAMD`.
pub(super) fn is_bf16_fast_by(vendor: [u8; 4]) -> bool {
    vendor == *b"Auth"
}

macro_rules! simd {
    ($simd:ident, $half:ty, $element:ty, $features:literal) => {
        impl Simd for $simd {
            type Element = $element;
            const VECS_MAX: usize = 4;

            /// The accumulators, the columns and one row fit into the 32 registers.
            fn rows_max(vecs: usize) -> usize {
                match vecs {
                    1 => 16,
                    2 => 12,
                    _ => 6,
                }
            }

            #[target_feature(enable = $features)]
            unsafe fn compute(self, tile: &RawTile<$element>, rows: usize, vecs: usize) {
                // SAFETY: `new` found the instructions; the caller guarantees the rest.
                if vecs == 1 && tile.cols <= HALF {
                    return compute_sizes!($half, tile, rows, vecs;
                        1: 1 2 3 4 5 6 7 8 9 10 11 12 13 14 15 16;
                    );
                }
                compute_sizes!(Self, tile, rows, vecs;
                    1: 1 2 3 4 5 6 7 8 9 10 11 12 13 14 15 16;
                    2: 1 2 3 4 5 6 7 8 9 10 11 12;
                    4: 1 2 3 4 5 6;
                )
            }

            #[inline(always)]
            fn transpose(self, block: &mut [[u32; LANES]; LANES]) {
                // SAFETY: `new` found the instructions.
                unsafe { transpose_block(block) }
            }

            #[inline(always)]
            fn vectorize<W: Loop>(self, work: W) {
                // SAFETY: `new` found the instructions.
                unsafe { Self::vectorized(work) }
            }
        }

        impl $simd {
            #[target_feature(enable = $features)]
            unsafe fn vectorized<W: Loop>(work: W) {
                work.run();
            }
        }
    };
}

simd!(F32, HalfF32, f32, "avx512f,avx512bw,avx512dq,avx512vl,fma");
simd!(
    Bf16,
    HalfBf16,
    bf16,
    "avx512f,avx512bw,avx512dq,avx512vl,avx512bf16,fma"
);

impl Rounding for F32 {}

/// Implements [`Rounding`] for an instruction set with AVX512_BF16.
macro_rules! bf16_rounding {
    ($simd:ty) => {
        impl Rounding for $simd {
            #[inline(always)]
            fn round(self, values: &[f32], to: &mut [bf16]) {
                // SAFETY: `new` found the instructions.
                unsafe { avx512_rounding::round(values, to) }
            }

            #[inline(always)]
            fn round_pairs(self, first: &[f32], second: &[f32], pairs: &mut [bf16]) {
                // SAFETY: `new` found the instructions.
                unsafe { avx512_rounding::round_pairs(first, second, pairs) }
            }

            #[inline(always)]
            fn pair(self, first: &[bf16], second: &[bf16], pairs: &mut [bf16]) {
                // SAFETY: `new` found the instructions.
                unsafe { avx512_rounding::pair(first, second, pairs) }
            }

            #[inline(always)]
            fn convert_bytes(self, bytes: &[u8], to: &mut [bf16]) {
                // SAFETY: `new` found the instructions.
                unsafe { avx512_rounding::convert_bytes(bytes, to) }
            }
        }
    };
}
pub(super) use bf16_rounding;

bf16_rounding!(Bf16);

/// Transposes 16 registers of 16 words: exchanges 32-bit words, pairs of them, then quarters of registers twice.
#[inline]
#[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl,fma")]
unsafe fn transpose_block(block: &mut [[u32; LANES]; LANES]) {
    // SAFETY: every row of the block is the 64 bytes of a register, read and written where it is.
    let rows: [__m512i; LANES] =
        std::array::from_fn(|row| unsafe { _mm512_loadu_si512(block[row].as_ptr().cast()) });
    let pairs: [__m512i; LANES] = std::array::from_fn(|at| {
        let (a, b) = (rows[at & !1], rows[at | 1]);
        if at & 1 == 0 {
            _mm512_unpacklo_epi32(a, b)
        } else {
            _mm512_unpackhi_epi32(a, b)
        }
    });
    // Each register holds four rows, with columns 4 q + at % 4 in quarter q.
    let fours: [__m512i; LANES] = std::array::from_fn(|at| {
        let first = (at & !3) + (at & 2) / 2;
        let (a, b) = (pairs[first], pairs[first + 2]);
        if at & 1 == 0 {
            _mm512_unpacklo_epi64(a, b)
        } else {
            _mm512_unpackhi_epi64(a, b)
        }
    });
    let column = |at: usize| at & 3;
    let eights: [__m512i; LANES] = std::array::from_fn(|at| {
        // Holds rows 0..8 for at < 8, else 8..16, and quarters 0 and 2, or 1 and 3.
        let first = at / 8 * 8 + column(at);
        let (a, b) = (fours[first], fours[first + 4]);
        if at & 4 == 0 {
            _mm512_shuffle_i32x4::<0b10_00_10_00>(a, b)
        } else {
            _mm512_shuffle_i32x4::<0b11_01_11_01>(a, b)
        }
    });
    for (step, row) in block.iter_mut().enumerate() {
        let (quarter, at) = (step / 4, step & 3);
        let from = at + (quarter & 1) * 4;
        let (a, b) = (eights[from], eights[from + 8]);
        let done = if quarter < 2 {
            _mm512_shuffle_i32x4::<0b10_00_10_00>(a, b)
        } else {
            _mm512_shuffle_i32x4::<0b11_01_11_01>(a, b)
        };
        // SAFETY: as above.
        unsafe { _mm512_storeu_si512(row.as_mut_ptr().cast(), done) };
    }
}

/// Vectors of half a register, for tiles of at most [`HALF`] columns, as the first stage of a narrow residual torso has. A processor that
/// executes instructions on whole registers in two halves, such as Zen 4, then needs half the time.
#[derive(Clone, Copy)]
enum HalfF32 {}

/// [`HalfF32`] of bf16 operands in pairs.
#[derive(Clone, Copy)]
enum HalfBf16 {}

const HALF: usize = LANES / 2;

/// Defines the vectors of registers of one width by their types and intrinsics.
macro_rules! vectors {
    (
        $f32:ty, $bf16:ty, $lanes:expr, $mask:ty, $floats:ty, $words:ty, $pairs:ty;
        $set_float:ident $set_word:ident $load_floats:ident $load_words:ident $multiply:ident $multiply_pairs:ident
        $add:ident $load_first:ident $store_first:ident
    ) => {
        impl Sums for $floats {
            #[inline(always)]
            unsafe fn zero() -> Self {
                unsafe { $set_float(0.0) }
            }

            #[inline(always)]
            unsafe fn write(self, at: *mut f32, count: usize, add: bool) {
                let mask = first_lanes(count.min($lanes)) as $mask;
                // SAFETY: the mask excludes lanes that must not be accessed; the caller guarantees the others.
                unsafe {
                    let sums = if add {
                        $add($load_first(mask, at), self)
                    } else {
                        self
                    };
                    $store_first(at, mask, sums);
                }
            }
        }

        // SAFETY for both: loads use addresses that the caller guarantees. None of them needs alignment.

        impl Vector for $f32 {
            type Element = f32;
            type Sums = $floats;
            type Operand = $floats;
            const REGISTERS: usize = 32;

            #[inline(always)]
            unsafe fn load_row(at: *const f32) -> $floats {
                unsafe { $set_float(*at) }
            }

            #[inline(always)]
            unsafe fn load_columns(at: *const f32) -> $floats {
                unsafe { $load_floats(at) }
            }

            #[inline(always)]
            unsafe fn mul_add(sums: $floats, row: $floats, columns: $floats) -> $floats {
                unsafe { $multiply(row, columns, sums) }
            }
        }

        impl Vector for $bf16 {
            type Element = bf16;
            type Sums = $floats;
            type Operand = $words;
            const REGISTERS: usize = 32;

            #[inline(always)]
            unsafe fn load_row(at: *const bf16) -> $words {
                unsafe { $set_word(at.cast::<i32>().read_unaligned()) }
            }

            #[inline(always)]
            unsafe fn load_columns(at: *const bf16) -> $words {
                unsafe { $load_words(at.cast()) }
            }

            #[inline(always)]
            unsafe fn mul_add(sums: $floats, row: $words, columns: $words) -> $floats {
                // The row is the last argument, because the instruction can broadcast that one from memory. A
                // separate broadcast takes a third of the loop's time.
                // SAFETY: both types are one register of bf16.
                unsafe {
                    let columns = transmute::<$words, $pairs>(columns);
                    $multiply_pairs(sums, columns, transmute::<$words, $pairs>(row))
                }
            }
        }
    };
}

vectors!(
    F32, Bf16, LANES, u16, __m512, __m512i, __m512bh;
    _mm512_set1_ps _mm512_set1_epi32 _mm512_loadu_ps _mm512_loadu_si512 _mm512_fmadd_ps _mm512_dpbf16_ps
    _mm512_add_ps _mm512_maskz_loadu_ps _mm512_mask_storeu_ps
);

vectors!(
    HalfF32, HalfBf16, HALF, u8, __m256, __m256i, __m256bh;
    _mm256_set1_ps _mm256_set1_epi32 _mm256_loadu_ps _mm256_loadu_si256 _mm256_fmadd_ps _mm256_dpbf16_ps
    _mm256_add_ps _mm256_maskz_loadu_ps _mm256_mask_storeu_ps
);
