//! AVX-512: 16 f32 products an instruction, or with AVX512_BF16 32 bf16 products summed in pairs.
#![allow(unsafe_code, reason = "instructions of one kind of processor")]
#![cfg(target_arch = "x86_64")]

use std::arch::x86_64::{
    __m256bh, __m256i, __m512, __m512bh, __m512i, _mm_loadu_si128, _mm256_mask_storeu_epi16,
    _mm512_add_ps, _mm512_castps_si512, _mm512_cvtepi32_ps, _mm512_cvtepu8_epi32,
    _mm512_cvtne2ps_pbh, _mm512_cvtneps_pbh, _mm512_dpbf16_ps, _mm512_fmadd_ps, _mm512_loadu_ps,
    _mm512_loadu_si512, _mm512_mask_storeu_epi16, _mm512_mask_storeu_ps, _mm512_maskz_loadu_ps,
    _mm512_or_si512, _mm512_permutex2var_epi16, _mm512_permutexvar_epi16, _mm512_set1_epi32,
    _mm512_set1_ps, _mm512_setzero_ps, _mm512_shuffle_i32x4, _mm512_srli_epi32,
    _mm512_storeu_si512, _mm512_unpackhi_epi32, _mm512_unpackhi_epi64, _mm512_unpacklo_epi32,
    _mm512_unpacklo_epi64,
};
use std::mem::transmute;

use half::bf16;

use super::{
    element::{Element, Rounding},
    unit::{LANES, Loop, RawTile, Unit},
    vector::{Vector, compute_sizes},
};

/// Whether this processor, and the operating system, have AVX-512 as server processors do.
pub(super) fn available() -> bool {
    is_x86_feature_detected!("avx512f")
        && is_x86_feature_detected!("avx512bw")
        && is_x86_feature_detected!("avx512dq")
        && is_x86_feature_detected!("avx512vl")
        && is_x86_feature_detected!("fma")
}

#[derive(Clone, Copy)]
pub(super) struct Single(());

/// bf16 operands in pairs.
#[derive(Clone, Copy)]
pub(super) struct Brain(());

impl Single {
    /// # Panics
    /// If the processor lacks it.
    pub(super) fn here() -> Self {
        assert!(available(), "no AVX-512");
        Self(())
    }
}

impl Brain {
    /// Whether this processor has AVX512_BF16 beside AVX-512.
    pub(super) fn available() -> bool {
        available() && is_x86_feature_detected!("avx512bf16")
    }

    /// # Panics
    /// If the processor lacks it.
    pub(super) fn here() -> Self {
        assert!(Self::available(), "no AVX512_BF16");
        Self(())
    }
}

/// Rows of a tile: with its columns and one row they fill the 32 registers.
const fn rows_max(vecs: usize) -> usize {
    if vecs > 2 { 6 } else { 8 }
}

macro_rules! unit {
    ($unit:ident, $element:ty, $features:literal) => {
        impl Unit for $unit {
            type Element = $element;
            const VECS_MAX: usize = 4;

            fn rows_max(vecs: usize) -> usize {
                rows_max(vecs)
            }

            unsafe fn compute(self, tile: &RawTile<$element>, rows: usize, vecs: usize) {
                // SAFETY: `here` found the instructions; the rest is the caller's.
                unsafe { Self::compute_sized(tile, rows, vecs) }
            }

            #[inline(always)]
            fn transpose(self, block: &mut [[u32; LANES]; LANES]) {
                // SAFETY: `here` found the instructions.
                unsafe { transposed(block) }
            }

            #[inline(always)]
            fn vectorize<W: Loop>(self, work: W) {
                // SAFETY: `here` found the instructions.
                unsafe { Self::vectorized(work) }
            }
        }

        impl $unit {
            #[target_feature(enable = $features)]
            unsafe fn vectorized<W: Loop>(work: W) {
                work.run();
            }

            #[target_feature(enable = $features)]
            unsafe fn compute_sized(tile: &RawTile<$element>, rows: usize, vecs: usize) {
                compute_sizes!(Self, tile, rows, vecs;
                    1: 1 2 3 4 5 6 7 8;
                    2: 1 2 3 4 5 6 7 8;
                    4: 1 2 3 4 5 6;
                )
            }
        }
    };
}

unit!(Single, f32, "avx512f,avx512bw,avx512dq,avx512vl,fma");
unit!(
    Brain,
    bf16,
    "avx512f,avx512bw,avx512dq,avx512vl,avx512bf16,fma"
);

impl Rounding for Single {}

impl Rounding for Brain {
    #[inline(always)]
    fn round(self, values: &[f32], to: &mut [bf16]) {
        // SAFETY: `here` found the instructions.
        unsafe { rounded(values, to) }
    }

    #[inline(always)]
    fn round_pairs(self, first: &[f32], second: &[f32], pairs: &mut [bf16]) {
        // SAFETY: `here` found the instructions.
        unsafe { rounded_pairs(first, second, pairs) }
    }

    #[inline(always)]
    fn pair(self, first: &[bf16], second: &[bf16], pairs: &mut [bf16]) {
        // SAFETY: `here` found the instructions.
        unsafe { paired(first, second, pairs) }
    }

    #[inline(always)]
    fn of_bytes(self, bytes: &[u8], to: &mut [bf16]) {
        // SAFETY: `here` found the instructions.
        unsafe { of_bytes(bytes, to) }
    }

    #[inline(always)]
    fn pair_bytes(self, first: &[u8], second: &[u8], pairs: &mut [bf16]) {
        // SAFETY: `here` found the instructions.
        unsafe { paired_bytes(first, second, pairs) }
    }
}

/// `Rounding::round`, 32 values at a time.
#[inline]
#[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl,avx512bf16,fma")]
unsafe fn rounded(values: &[f32], to: &mut [bf16]) {
    let to = &mut to[..values.len()];
    let (blocks, tail) = values.as_chunks::<{ 2 * LANES }>();
    let (to_blocks, to_tail) = to.as_chunks_mut::<{ 2 * LANES }>();
    for (block, to) in blocks.iter().zip(to_blocks) {
        // SAFETY: a block is two registers of f32, and what it is rounded to one of bf16.
        unsafe {
            let (low, high) = (
                _mm512_loadu_ps(block.as_ptr()),
                _mm512_loadu_ps(block[LANES..].as_ptr()),
            );
            let words = transmute::<__m512bh, __m512i>(_mm512_cvtne2ps_pbh(high, low));
            _mm512_storeu_si512(to.as_mut_ptr().cast(), words);
        }
    }
    for (part, to) in tail.chunks(LANES).zip(to_tail.chunks_mut(LANES)) {
        let mask = first_lanes(part.len());
        // SAFETY: the mask leaves out what lies beyond the slices, which are as long as each other and at most a register.
        unsafe {
            let words = _mm512_cvtneps_pbh(_mm512_maskz_loadu_ps(mask, part.as_ptr()));
            let words = transmute::<__m256bh, __m256i>(words);
            _mm256_mask_storeu_epi16(to.as_mut_ptr().cast(), mask, words);
        }
    }
}

/// `Rounding::round_pairs`, 16 pairs at a time.
#[inline]
#[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl,avx512bf16,fma")]
unsafe fn rounded_pairs(first: &[f32], second: &[f32], pairs: &mut [bf16]) {
    // Word i of a pair's register is i / 2 of the first row's words, 0 to 15, or of the second's, 16 to 31.
    const ORDER: [u16; 2 * LANES] = {
        let mut order = [0; 2 * LANES];
        let mut at = 0;
        while at < order.len() {
            order[at] = (at / 2 + at % 2 * LANES) as u16;
            at += 1;
        }
        order
    };
    // SAFETY: `ORDER` is the 64 bytes of a register.
    let order = unsafe { _mm512_loadu_si512(ORDER.as_ptr().cast()) };
    let interleaved = |first: __m512, second: __m512| {
        // SAFETY: two names of one register of 32 bf16.
        let words = unsafe { transmute::<__m512bh, __m512i>(_mm512_cvtne2ps_pbh(second, first)) };
        _mm512_permutexvar_epi16(order, words)
    };
    let columns = first.len().min(second.len());
    let (first, second) = (&first[..columns], &second[..columns]);
    let pairs = &mut pairs[..2 * columns];
    let (first_blocks, first_tail) = first.as_chunks::<LANES>();
    let (second_blocks, second_tail) = second.as_chunks::<LANES>();
    let (pair_blocks, pair_tail) = pairs.as_chunks_mut::<{ 2 * LANES }>();
    for ((pairs, first), second) in pair_blocks.iter_mut().zip(first_blocks).zip(second_blocks) {
        // SAFETY: a block of either row is a register of f32, and its pairs one of bf16.
        unsafe {
            let words = interleaved(
                _mm512_loadu_ps(first.as_ptr()),
                _mm512_loadu_ps(second.as_ptr()),
            );
            _mm512_storeu_si512(pairs.as_mut_ptr().cast(), words);
        }
    }
    if !first_tail.is_empty() {
        let mask = first_lanes(first_tail.len());
        let words_mask = ((1u64 << (2 * first_tail.len())) - 1) as u32;
        // SAFETY: the masks leave out what lies beyond the slices, fewer than `LANES` columns of each row.
        unsafe {
            let words = interleaved(
                _mm512_maskz_loadu_ps(mask, first_tail.as_ptr()),
                _mm512_maskz_loadu_ps(mask, second_tail.as_ptr()),
            );
            _mm512_mask_storeu_epi16(pair_tail.as_mut_ptr().cast(), words_mask, words);
        }
    }
}

/// `Rounding::pair`, 32 pairs at a time.
#[inline]
#[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl,avx512bf16,fma")]
unsafe fn paired(first: &[bf16], second: &[bf16], pairs: &mut [bf16]) {
    // Word i of the first or second register of pairs is word i / 2, or 16 + i / 2, of the first row's, 0 to 31, or of the second's.
    const ORDERS: [[u16; 2 * LANES]; 2] = {
        let mut orders = [[0; 2 * LANES]; 2];
        let mut at = 0;
        while at < 2 * LANES {
            let word = at / 2 + at % 2 * 2 * LANES;
            (orders[0][at], orders[1][at]) = (word as u16, (word + LANES) as u16);
            at += 1;
        }
        orders
    };
    // SAFETY: each of `ORDERS` is the 64 bytes of a register.
    let orders = ORDERS.map(|order| unsafe { _mm512_loadu_si512(order.as_ptr().cast()) });
    let columns = first.len().min(second.len());
    let pairs = &mut pairs[..2 * columns];
    let (first_blocks, first_tail) = first[..columns].as_chunks::<{ 2 * LANES }>();
    let (second_blocks, second_tail) = second[..columns].as_chunks::<{ 2 * LANES }>();
    let (pair_blocks, pair_tail) = pairs.as_chunks_mut::<{ 4 * LANES }>();
    for ((pairs, first), second) in pair_blocks.iter_mut().zip(first_blocks).zip(second_blocks) {
        // SAFETY: a block of either row is a register of bf16, and its pairs two.
        unsafe {
            let (first, second) = (
                _mm512_loadu_si512(first.as_ptr().cast()),
                _mm512_loadu_si512(second.as_ptr().cast()),
            );
            for (half, order) in pairs.chunks_exact_mut(2 * LANES).zip(orders) {
                let words = _mm512_permutex2var_epi16(first, order, second);
                _mm512_storeu_si512(half.as_mut_ptr().cast(), words);
            }
        }
    }
    for ((pair, &first), &second) in pair_tail
        .chunks_exact_mut(2)
        .zip(first_tail)
        .zip(second_tail)
    {
        (pair[0], pair[1]) = (first, second);
    }
}

/// The f32 of 16 bytes, whose lower 16 bits are 0.
#[inline]
#[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl,avx512bf16,fma")]
unsafe fn floats_of(bytes: &[u8; LANES]) -> __m512 {
    // SAFETY: 16 bytes are a register of them.
    let bytes = unsafe { _mm_loadu_si128(bytes.as_ptr().cast()) };
    _mm512_cvtepi32_ps(_mm512_cvtepu8_epi32(bytes))
}

/// `Rounding::of_bytes`, 32 pixels at a time.
#[inline]
#[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl,avx512bf16,fma")]
unsafe fn of_bytes(bytes: &[u8], to: &mut [bf16]) {
    let to = &mut to[..bytes.len()];
    let (blocks, tail) = bytes.as_chunks::<{ 2 * LANES }>();
    let (to_blocks, to_tail) = to.as_chunks_mut::<{ 2 * LANES }>();
    for (block, to) in blocks.iter().zip(to_blocks) {
        let [low, high] = block.as_chunks::<LANES>().0 else {
            unreachable!("two halves")
        };
        // SAFETY: what 32 bytes become is a register of bf16.
        unsafe {
            let words = _mm512_cvtne2ps_pbh(floats_of(high), floats_of(low));
            let words = transmute::<__m512bh, __m512i>(words);
            _mm512_storeu_si512(to.as_mut_ptr().cast(), words);
        }
    }
    for (to, &byte) in to_tail.iter_mut().zip(tail) {
        *to = bf16::of_byte(byte);
    }
}

/// `Rounding::pair_bytes`, 16 pairs at a time.
#[inline]
#[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl,avx512bf16,fma")]
unsafe fn paired_bytes(first: &[u8], second: &[u8], pairs: &mut [bf16]) {
    let columns = first.len().min(second.len());
    let pairs = &mut pairs[..2 * columns];
    let (first_blocks, first_tail) = first[..columns].as_chunks::<LANES>();
    let (second_blocks, second_tail) = second[..columns].as_chunks::<LANES>();
    let (pair_blocks, pair_tail) = pairs.as_chunks_mut::<{ 2 * LANES }>();
    for ((pairs, first), second) in pair_blocks.iter_mut().zip(first_blocks).zip(second_blocks) {
        // SAFETY: what 16 bytes of either row become is a register of pairs.
        unsafe {
            let first = _mm512_srli_epi32::<16>(_mm512_castps_si512(floats_of(first)));
            let second = _mm512_castps_si512(floats_of(second));
            let words = _mm512_or_si512(first, second);
            _mm512_storeu_si512(pairs.as_mut_ptr().cast(), words);
        }
    }
    for ((pair, &first), &second) in pair_tail
        .chunks_exact_mut(2)
        .zip(first_tail)
        .zip(second_tail)
    {
        (pair[0], pair[1]) = (bf16::of_byte(first), bf16::of_byte(second));
    }
}

/// A mask of the first `count` of 16 lanes.
#[inline(always)]
const fn first_lanes(count: usize) -> u16 {
    ((1u32 << count) - 1) as u16
}

/// Transposes 16 registers of 16: pairs of 32 bits, of 64 bits, then quarters of registers twice.
#[inline]
#[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl,fma")]
unsafe fn transposed(block: &mut [[u32; LANES]; LANES]) {
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
    // Of four rows, columns 4 q + at % 4 in quarter q.
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
        // Rows 0..8 for at < 8, else 8..16; of quarters 0 and 2, or 1 and 3.
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

/// Writes the first `count` of 16 sums.
#[inline(always)]
unsafe fn write(sums: __m512, at: *mut f32, count: usize, add: bool) {
    debug_assert!(count <= LANES);
    let mask = first_lanes(count);
    // SAFETY: the lanes that the mask leaves out are neither read nor written; the caller answers for the others.
    unsafe {
        let sums = if add {
            _mm512_add_ps(_mm512_maskz_loadu_ps(mask, at), sums)
        } else {
            sums
        };
        _mm512_mask_storeu_ps(at, mask, sums);
    }
}

// SAFETY of both: loads and stores are of the addresses that the caller vouches for; none of them asks for alignment.

impl Vector for Single {
    type Element = f32;
    type Sums = __m512;
    type Operand = __m512;

    #[inline(always)]
    unsafe fn zero() -> __m512 {
        unsafe { _mm512_setzero_ps() }
    }

    #[inline(always)]
    unsafe fn row(at: *const f32) -> __m512 {
        unsafe { _mm512_set1_ps(*at) }
    }

    #[inline(always)]
    unsafe fn columns(at: *const f32) -> __m512 {
        unsafe { _mm512_loadu_ps(at) }
    }

    #[inline(always)]
    unsafe fn mul_add(sums: __m512, row: __m512, columns: __m512) -> __m512 {
        unsafe { _mm512_fmadd_ps(row, columns, sums) }
    }

    #[inline(always)]
    unsafe fn write(sums: __m512, at: *mut f32, count: usize, add: bool) {
        unsafe { write(sums, at, count, add) }
    }
}

impl Vector for Brain {
    type Element = bf16;
    type Sums = __m512;
    type Operand = __m512i;

    #[inline(always)]
    unsafe fn zero() -> __m512 {
        unsafe { _mm512_setzero_ps() }
    }

    #[inline(always)]
    unsafe fn row(at: *const bf16) -> __m512i {
        unsafe { _mm512_set1_epi32(at.cast::<i32>().read_unaligned()) }
    }

    #[inline(always)]
    unsafe fn columns(at: *const bf16) -> __m512i {
        unsafe { _mm512_loadu_si512(at.cast()) }
    }

    #[inline(always)]
    unsafe fn mul_add(sums: __m512, row: __m512i, columns: __m512i) -> __m512 {
        // SAFETY: two names of one register of 32 bf16.
        unsafe {
            _mm512_dpbf16_ps(
                sums,
                transmute::<__m512i, __m512bh>(row),
                transmute::<__m512i, __m512bh>(columns),
            )
        }
    }

    #[inline(always)]
    unsafe fn write(sums: __m512, at: *mut f32, count: usize, add: bool) {
        unsafe { write(sums, at, count, add) }
    }
}
