//! AVX2: 8 f32 products an instruction. bf16 operands are widened to f32 first.
#![allow(unsafe_code, reason = "instructions of one kind of processor")]
#![cfg(target_arch = "x86_64")]

use std::arch::x86_64::{
    __m256, __m256i, _mm256_add_ps, _mm256_and_si256, _mm256_castsi256_ps, _mm256_fmadd_ps,
    _mm256_loadu_ps, _mm256_loadu_si256, _mm256_set1_epi32, _mm256_set1_ps, _mm256_setzero_ps,
    _mm256_slli_epi32, _mm256_storeu_ps,
};
use std::marker::PhantomData;

use half::bf16;

use super::{
    element::Rounding,
    simd::{Loop, RawTile, Simd},
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
                if tile.cols <= REGISTER {
                    return compute_sizes!(Registers<$element, 1>, tile, rows, vecs; 1: 1 2 3 4 5 6;);
                }
                compute_sizes!(Registers<$element, 2>, tile, rows, vecs; 1: 1 2 3 4 5 6;);
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

/// The columns of one register.
const REGISTER: usize = 8;

/// The vectors of a tile of at most `N` times [`REGISTER`] columns.
#[derive(Clone, Copy)]
struct Registers<E, const N: usize>(PhantomData<E>);

impl<const N: usize> Sums for [__m256; N] {
    #[inline(always)]
    unsafe fn zero() -> Self {
        unsafe { [_mm256_setzero_ps(); N] }
    }

    #[inline(always)]
    unsafe fn write(self, at: *mut f32, count: usize, add: bool) {
        // SAFETY: whole registers are accessed only if `count` fills them, else only the first `count` scalars.
        unsafe {
            if count == N * REGISTER {
                for (register, sums) in self.into_iter().enumerate() {
                    let at = at.add(register * REGISTER);
                    let old = if add {
                        _mm256_loadu_ps(at)
                    } else {
                        _mm256_setzero_ps()
                    };
                    _mm256_storeu_ps(at, if add { _mm256_add_ps(old, sums) } else { sums });
                }
                return;
            }
            let mut values = [[0f32; REGISTER]; N];
            for (values, sums) in values.iter_mut().zip(self) {
                _mm256_storeu_ps(values.as_mut_ptr(), sums);
            }
            for (index, &value) in values.as_flattened().iter().take(count).enumerate() {
                let at = at.add(index);
                *at = if add { *at + value } else { value };
            }
        }
    }
}

// SAFETY for both: loads and stores use addresses that the caller guarantees. None of them needs alignment. No closures: they could be
// compiled without AVX2, and each instruction would then be a call.

impl<const N: usize> Vector for Registers<f32, N> {
    type Element = f32;
    type Sums = [__m256; N];
    type Operand = [__m256; N];

    #[inline(always)]
    unsafe fn load_row(at: *const f32) -> [__m256; N] {
        unsafe { [_mm256_set1_ps(*at); N] }
    }

    #[inline(always)]
    unsafe fn load_columns(at: *const f32) -> [__m256; N] {
        unsafe {
            let mut columns = [_mm256_loadu_ps(at); N];
            for (register, columns) in columns.iter_mut().enumerate() {
                *columns = _mm256_loadu_ps(at.add(register * REGISTER));
            }
            columns
        }
    }

    #[inline(always)]
    unsafe fn mul_add(
        mut sums: [__m256; N],
        row: [__m256; N],
        columns: [__m256; N],
    ) -> [__m256; N] {
        for (sums, (row, columns)) in sums.iter_mut().zip(row.into_iter().zip(columns)) {
            *sums = unsafe { _mm256_fmadd_ps(row, columns, *sums) };
        }
        sums
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

impl<const N: usize> Vector for Registers<bf16, N> {
    type Element = bf16;
    type Sums = [__m256; N];
    type Operand = [__m256i; N];

    #[inline(always)]
    unsafe fn load_row(at: *const bf16) -> [__m256i; N] {
        unsafe { [_mm256_set1_epi32(at.cast::<i32>().read_unaligned()); N] }
    }

    #[inline(always)]
    unsafe fn load_columns(at: *const bf16) -> [__m256i; N] {
        unsafe {
            let mut columns = [_mm256_loadu_si256(at.cast()); N];
            for (register, columns) in columns.iter_mut().enumerate() {
                *columns = _mm256_loadu_si256(at.add(register * 2 * REGISTER).cast());
            }
            columns
        }
    }

    #[inline(always)]
    unsafe fn mul_add(
        mut sums: [__m256; N],
        row: [__m256i; N],
        columns: [__m256i; N],
    ) -> [__m256; N] {
        for (sums, (row, columns)) in sums.iter_mut().zip(row.into_iter().zip(columns)) {
            *sums = unsafe { mul_add_pairs(*sums, row, columns) };
        }
        sums
    }
}
