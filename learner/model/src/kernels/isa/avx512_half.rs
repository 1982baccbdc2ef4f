//! AVX-512 on half a register: tiles of at most 8 columns, as the first stage of a narrow residual torso has.
//! A processor that executes an instruction on whole registers in two halves, such as Zen 4, needs half the time.
#![allow(unsafe_code, reason = "instructions of one kind of processor")]
#![cfg(target_arch = "x86_64")]

use std::arch::x86_64::{
    __m256, __m256bh, __m256i, _mm256_add_ps, _mm256_dpbf16_ps, _mm256_fmadd_ps, _mm256_loadu_ps,
    _mm256_loadu_si256, _mm256_mask_storeu_ps, _mm256_maskz_loadu_ps, _mm256_set1_epi32,
    _mm256_set1_ps, _mm256_setzero_ps,
};
use std::mem::transmute;

use half::bf16;

use super::{
    avx512_rounding::first_lanes,
    simd::LANES,
    vector::{Sums, Vector},
};

/// The columns of a tile that these vectors compute.
pub(super) const HALF: usize = LANES / 2;

#[derive(Clone, Copy)]
pub(super) enum F32 {}

/// bf16 operands in pairs.
#[derive(Clone, Copy)]
pub(super) enum Bf16 {}

impl Sums for __m256 {
    #[inline(always)]
    unsafe fn zero() -> Self {
        unsafe { _mm256_setzero_ps() }
    }

    #[inline(always)]
    unsafe fn write(self, at: *mut f32, count: usize, add: bool) {
        let mask = first_lanes(count.min(HALF)) as u8;
        // SAFETY: the mask excludes lanes that must not be accessed; the caller guarantees the others.
        unsafe {
            let sums = if add {
                _mm256_add_ps(_mm256_maskz_loadu_ps(mask, at), self)
            } else {
                self
            };
            _mm256_mask_storeu_ps(at, mask, sums);
        }
    }
}

// SAFETY for both: loads use addresses that the caller guarantees. None of them needs alignment.

impl Vector for F32 {
    type Element = f32;
    type Sums = __m256;
    type Operand = __m256;
    const REGISTERS: usize = 32;

    #[inline(always)]
    unsafe fn load_row(at: *const f32) -> __m256 {
        unsafe { _mm256_set1_ps(*at) }
    }

    #[inline(always)]
    unsafe fn load_columns(at: *const f32) -> __m256 {
        unsafe { _mm256_loadu_ps(at) }
    }

    #[inline(always)]
    unsafe fn mul_add(sums: __m256, row: __m256, columns: __m256) -> __m256 {
        unsafe { _mm256_fmadd_ps(row, columns, sums) }
    }
}

impl Vector for Bf16 {
    type Element = bf16;
    type Sums = __m256;
    type Operand = __m256i;
    const REGISTERS: usize = 32;

    #[inline(always)]
    unsafe fn load_row(at: *const bf16) -> __m256i {
        unsafe { _mm256_set1_epi32(at.cast::<i32>().read_unaligned()) }
    }

    #[inline(always)]
    unsafe fn load_columns(at: *const bf16) -> __m256i {
        unsafe { _mm256_loadu_si256(at.cast()) }
    }

    #[inline(always)]
    unsafe fn mul_add(sums: __m256, row: __m256i, columns: __m256i) -> __m256 {
        // The row is the last argument, which the instruction can broadcast from memory.
        // SAFETY: both types are one register of 16 bf16.
        unsafe {
            _mm256_dpbf16_ps(
                sums,
                transmute::<__m256i, __m256bh>(columns),
                transmute::<__m256i, __m256bh>(row),
            )
        }
    }
}
