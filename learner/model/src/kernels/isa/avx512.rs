//! AVX-512: 16 f32 products an instruction, or with AVX512_BF16 32 bf16 products summed in pairs.
#![allow(unsafe_code, reason = "instructions of one kind of processor")]
#![cfg(target_arch = "x86_64")]

use std::arch::x86_64::{
    __cpuid, __m512, __m512bh, __m512i, _mm512_add_ps, _mm512_dpbf16_ps, _mm512_fmadd_ps,
    _mm512_loadu_ps, _mm512_loadu_si512, _mm512_mask_storeu_ps, _mm512_maskz_loadu_ps,
    _mm512_set1_epi32, _mm512_set1_ps, _mm512_setzero_ps, _mm512_shuffle_i32x4,
    _mm512_storeu_si512, _mm512_unpackhi_epi32, _mm512_unpackhi_epi64, _mm512_unpacklo_epi32,
    _mm512_unpacklo_epi64,
};
use std::mem::transmute;

use half::bf16;

use super::{
    avx512_half::{self, HALF},
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

/// Most rows of a tile. The accumulators, the columns and one row must fit into the 32 registers.
const fn rows_max(vecs: usize) -> usize {
    match vecs {
        1 => 16,
        2 => 12,
        _ => 6,
    }
}

macro_rules! simd {
    ($simd:ident, $half:ty, $element:ty, $features:literal) => {
        impl Simd for $simd {
            type Element = $element;
            const VECS_MAX: usize = 4;

            fn rows_max(vecs: usize) -> usize {
                rows_max(vecs)
            }

            unsafe fn compute(self, tile: &RawTile<$element>, rows: usize, vecs: usize) {
                // SAFETY: `new` found the instructions; the caller guarantees the rest.
                unsafe { Self::compute_sized(tile, rows, vecs) }
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

            #[target_feature(enable = $features)]
            unsafe fn compute_sized(tile: &RawTile<$element>, rows: usize, vecs: usize) {
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
        }
    };
}

simd!(
    F32,
    avx512_half::F32,
    f32,
    "avx512f,avx512bw,avx512dq,avx512vl,fma"
);
simd!(
    Bf16,
    avx512_half::Bf16,
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

impl Sums for __m512 {
    #[inline(always)]
    unsafe fn zero() -> Self {
        unsafe { _mm512_setzero_ps() }
    }

    #[inline(always)]
    unsafe fn write(self, at: *mut f32, count: usize, add: bool) {
        debug_assert!(count <= LANES);
        let mask = first_lanes(count);
        // SAFETY: the mask excludes lanes that must not be accessed; the caller guarantees the others.
        unsafe {
            let sums = if add {
                _mm512_add_ps(_mm512_maskz_loadu_ps(mask, at), self)
            } else {
                self
            };
            _mm512_mask_storeu_ps(at, mask, sums);
        }
    }
}

// SAFETY for both: loads and stores use addresses that the caller guarantees. None of them needs alignment.

impl Vector for F32 {
    type Element = f32;
    type Sums = __m512;
    type Operand = __m512;
    const REGISTERS: usize = 32;

    #[inline(always)]
    unsafe fn load_row(at: *const f32) -> __m512 {
        unsafe { _mm512_set1_ps(*at) }
    }

    #[inline(always)]
    unsafe fn load_columns(at: *const f32) -> __m512 {
        unsafe { _mm512_loadu_ps(at) }
    }

    #[inline(always)]
    unsafe fn mul_add(sums: __m512, row: __m512, columns: __m512) -> __m512 {
        unsafe { _mm512_fmadd_ps(row, columns, sums) }
    }
}

impl Vector for Bf16 {
    type Element = bf16;
    type Sums = __m512;
    type Operand = __m512i;
    const REGISTERS: usize = 32;

    #[inline(always)]
    unsafe fn load_row(at: *const bf16) -> __m512i {
        unsafe { _mm512_set1_epi32(at.cast::<i32>().read_unaligned()) }
    }

    #[inline(always)]
    unsafe fn load_columns(at: *const bf16) -> __m512i {
        unsafe { _mm512_loadu_si512(at.cast()) }
    }

    #[inline(always)]
    unsafe fn mul_add(sums: __m512, row: __m512i, columns: __m512i) -> __m512 {
        // The row is the last argument, because the instruction can broadcast that one from memory. A
        // separate broadcast takes a third of the loop's time.
        // SAFETY: both types are one register of 32 bf16.
        unsafe {
            _mm512_dpbf16_ps(
                sums,
                transmute::<__m512i, __m512bh>(columns),
                transmute::<__m512i, __m512bh>(row),
            )
        }
    }
}
