//! AVX2: 8 f32 products an instruction. bf16 operands are widened to f32 first.
#![allow(unsafe_code, reason = "instructions of one kind of processor")]
#![cfg(target_arch = "x86_64")]

use std::arch::x86_64::{
    __m256, __m256i, _mm256_add_ps, _mm256_and_si256, _mm256_castsi256_ps, _mm256_fmadd_ps,
    _mm256_loadu_ps, _mm256_loadu_si256, _mm256_set1_epi32, _mm256_set1_ps, _mm256_setzero_ps,
    _mm256_slli_epi32, _mm256_storeu_ps,
};

use half::bf16;

use super::{
    element::Rounding,
    simd::{LANES, Loop, RawTile, Simd},
    vector::{Sums, Vector, compute_sizes},
};

#[derive(Clone, Copy)]
pub(crate) struct F32(());

/// bf16 operands in pairs, multiplied as f32.
#[derive(Clone, Copy)]
pub(crate) struct Bf16(());

macro_rules! simd {
    ($simd:ident, $element:ty) => {
        impl $simd {
            /// Returns the instruction set if the processor and the operating system have AVX2 and fused multiply-add.
            pub(super) fn new() -> Option<Self> {
                let is_available = is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma");
                is_available.then_some(Self(()))
            }
        }

        impl Rounding for $simd {}

        impl Simd for $simd {
            type Element = $element;
            const VECS_MAX: usize = 1;

            fn rows_max(_: usize) -> usize {
                6
            }

            #[target_feature(enable = "avx2,fma")]
            unsafe fn compute(self, tile: &RawTile<$element>, rows: usize, vecs: usize) {
                // SAFETY: `new` found the instructions; the caller guarantees the rest.
                compute_sizes!(Self, tile, rows, vecs; 1: 1 2 3 4 5 6;);
            }

            #[inline(always)]
            fn vectorize<W: Loop>(self, work: W) {
                // SAFETY: `new` found the instructions.
                unsafe { vectorized(work) }
            }
        }
    };
}

simd!(F32, f32);
simd!(Bf16, bf16);

#[target_feature(enable = "avx2,fma")]
unsafe fn vectorized<W: Loop>(work: W) {
    work.run();
}

impl Sums for [__m256; 2] {
    #[inline(always)]
    unsafe fn zero() -> Self {
        unsafe { [_mm256_setzero_ps(); 2] }
    }

    #[inline(always)]
    unsafe fn write(self, at: *mut f32, count: usize, add: bool) {
        // SAFETY: whole registers are accessed only if `count` is 16, else only the first `count` scalars.
        unsafe {
            if count == LANES {
                for (half, sums) in self.into_iter().enumerate() {
                    let at = at.add(half * 8);
                    let old = if add {
                        _mm256_loadu_ps(at)
                    } else {
                        _mm256_setzero_ps()
                    };
                    _mm256_storeu_ps(at, if add { _mm256_add_ps(old, sums) } else { sums });
                }
                return;
            }
            let mut values = [0f32; LANES];
            _mm256_storeu_ps(values.as_mut_ptr(), self[0]);
            _mm256_storeu_ps(values.as_mut_ptr().add(8), self[1]);
            for (index, value) in values.into_iter().take(count).enumerate() {
                let at = at.add(index);
                *at = if add { *at + value } else { value };
            }
        }
    }
}

// SAFETY for both: loads and stores use addresses that the caller guarantees. None of them needs alignment.

impl Vector for F32 {
    type Element = f32;
    type Sums = [__m256; 2];
    type Operand = [__m256; 2];

    #[inline(always)]
    unsafe fn load_row(at: *const f32) -> [__m256; 2] {
        unsafe { [_mm256_set1_ps(*at); 2] }
    }

    #[inline(always)]
    unsafe fn load_columns(at: *const f32) -> [__m256; 2] {
        unsafe { [_mm256_loadu_ps(at), _mm256_loadu_ps(at.add(8))] }
    }

    #[inline(always)]
    unsafe fn mul_add(sums: [__m256; 2], row: [__m256; 2], columns: [__m256; 2]) -> [__m256; 2] {
        unsafe {
            [
                _mm256_fmadd_ps(row[0], columns[0], sums[0]),
                _mm256_fmadd_ps(row[1], columns[1], sums[1]),
            ]
        }
    }
}

/// The lower of each pair of bf16, as f32.
#[inline(always)]
unsafe fn lower(pairs: __m256i) -> __m256 {
    unsafe { _mm256_castsi256_ps(_mm256_slli_epi32::<16>(pairs)) }
}

/// The upper of each pair of bf16, as f32.
#[inline(always)]
unsafe fn upper(pairs: __m256i) -> __m256 {
    unsafe {
        _mm256_castsi256_ps(_mm256_and_si256(
            pairs,
            _mm256_set1_epi32(0xffff_0000_u32 as i32),
        ))
    }
}

/// `sums` plus the products of both bf16 of each pair.
#[inline(always)]
unsafe fn mul_add_pairs(sums: __m256, row: __m256i, columns: __m256i) -> __m256 {
    unsafe {
        let first = _mm256_fmadd_ps(lower(row), lower(columns), sums);
        _mm256_fmadd_ps(upper(row), upper(columns), first)
    }
}

impl Vector for Bf16 {
    type Element = bf16;
    type Sums = [__m256; 2];
    type Operand = [__m256i; 2];

    #[inline(always)]
    unsafe fn load_row(at: *const bf16) -> [__m256i; 2] {
        unsafe { [_mm256_set1_epi32(at.cast::<i32>().read_unaligned()); 2] }
    }

    #[inline(always)]
    unsafe fn load_columns(at: *const bf16) -> [__m256i; 2] {
        unsafe {
            [
                _mm256_loadu_si256(at.cast()),
                _mm256_loadu_si256(at.add(LANES).cast()),
            ]
        }
    }

    #[inline(always)]
    unsafe fn mul_add(sums: [__m256; 2], row: [__m256i; 2], columns: [__m256i; 2]) -> [__m256; 2] {
        // No closure: it could be compiled without AVX2, and each instruction would then be a call.
        unsafe {
            [
                mul_add_pairs(sums[0], row[0], columns[0]),
                mul_add_pairs(sums[1], row[1], columns[1]),
            ]
        }
    }
}
