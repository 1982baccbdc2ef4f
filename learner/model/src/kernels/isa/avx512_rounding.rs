//! AVX512_BF16: the methods of `Rounding`, 16 or 32 scalars at a time.
//! It multiplies nothing: `avx512` does.
#![allow(unsafe_code, reason = "instructions of one kind of processor")]
#![cfg(target_arch = "x86_64")]

use std::arch::x86_64::{
    __m256bh, __m256i, __m512, __m512bh, __m512i, _mm_loadu_si128, _mm256_mask_storeu_epi16,
    _mm512_cvtepi32_ps, _mm512_cvtepu8_epi32, _mm512_cvtne2ps_pbh, _mm512_cvtneps_pbh,
    _mm512_loadu_ps, _mm512_loadu_si512, _mm512_mask_storeu_epi16, _mm512_maskz_loadu_ps,
    _mm512_permutex2var_epi16, _mm512_permutexvar_epi16, _mm512_storeu_si512,
};
use std::mem::transmute;

use half::bf16;

use super::{element::Element, simd::LANES};

/// `Rounding::round`, 32 values at a time.
#[inline]
#[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl,avx512bf16,fma")]
pub(super) unsafe fn round(values: &[f32], to: &mut [bf16]) {
    let to = &mut to[..values.len()];
    let (blocks, tail) = values.as_chunks::<{ 2 * LANES }>();
    let (to_blocks, to_tail) = to.as_chunks_mut::<{ 2 * LANES }>();
    for (block, to) in blocks.iter().zip(to_blocks) {
        // SAFETY: a block is two registers of f32, and what it is rounded to one of bf16.
        unsafe {
            let low = _mm512_loadu_ps(block.as_ptr());
            let high = _mm512_loadu_ps(block[LANES..].as_ptr());
            let words = transmute::<__m512bh, __m512i>(_mm512_cvtne2ps_pbh(high, low));
            _mm512_storeu_si512(to.as_mut_ptr().cast(), words);
        }
    }
    for (part, to) in tail.chunks(LANES).zip(to_tail.chunks_mut(LANES)) {
        let mask = first_lanes(part.len());
        // SAFETY: the mask excludes what lies beyond the slices, which are equally long and at most a register.
        unsafe {
            let words = _mm512_cvtneps_pbh(_mm512_maskz_loadu_ps(mask, part.as_ptr()));
            let words = transmute::<__m256bh, __m256i>(words);
            _mm256_mask_storeu_epi16(to.as_mut_ptr().cast(), mask, words);
        }
    }
}

/// The words that a register of pairs takes, from word `first` of two rows on. The second row's words follow `row_len` of the first's.
const fn pair_order(first: usize, row_len: usize) -> [u16; 2 * LANES] {
    let mut order = [0; 2 * LANES];
    let mut at = 0;
    while at < order.len() {
        order[at] = (first + at / 2 + at % 2 * row_len) as u16;
        at += 1;
    }
    order
}

/// `Rounding::round_pairs`, 16 pairs at a time.
#[inline]
#[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl,avx512bf16,fma")]
pub(super) unsafe fn round_pairs(first: &[f32], second: &[f32], pairs: &mut [bf16]) {
    // Words 0 to 15 are those of the first row.
    const ORDER: [u16; 2 * LANES] = pair_order(0, LANES);
    // SAFETY: `ORDER` is the 64 bytes of a register.
    let order = unsafe { _mm512_loadu_si512(ORDER.as_ptr().cast()) };
    let interleaved = |first: __m512, second: __m512| {
        // SAFETY: both types are one register of 32 bf16.
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
        // SAFETY: the masks exclude what lies beyond the slices. Each row has fewer than `LANES` columns left.
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
pub(super) unsafe fn pair(first: &[bf16], second: &[bf16], pairs: &mut [bf16]) {
    // Words 0 to 31 are those of the first row. The second register of pairs begins with the rows' words 16.
    const ORDERS: [[u16; 2 * LANES]; 2] = [pair_order(0, 2 * LANES), pair_order(LANES, 2 * LANES)];
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
            let first = _mm512_loadu_si512(first.as_ptr().cast());
            let second = _mm512_loadu_si512(second.as_ptr().cast());
            for (half, order) in pairs.chunks_exact_mut(2 * LANES).zip(orders) {
                let words = _mm512_permutex2var_epi16(first, order, second);
                _mm512_storeu_si512(half.as_mut_ptr().cast(), words);
            }
        }
    }
    let pairs = pair_tail.as_chunks_mut::<2>().0.iter_mut();
    for ((pair, &first), &second) in pairs.zip(first_tail).zip(second_tail) {
        *pair = [first, second];
    }
}

/// Converts 16 bytes to f32, whose lower 16 bits are 0.
#[inline]
#[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl,avx512bf16,fma")]
unsafe fn bytes_to_floats(bytes: &[u8; LANES]) -> __m512 {
    // SAFETY: 16 bytes are a register of them.
    let bytes = unsafe { _mm_loadu_si128(bytes.as_ptr().cast()) };
    _mm512_cvtepi32_ps(_mm512_cvtepu8_epi32(bytes))
}

/// `Rounding::convert_bytes`, 32 pixels at a time.
#[inline]
#[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl,avx512bf16,fma")]
pub(super) unsafe fn convert_bytes(bytes: &[u8], to: &mut [bf16]) {
    let to = &mut to[..bytes.len()];
    let (blocks, tail) = bytes.as_chunks::<{ 2 * LANES }>();
    let (to_blocks, to_tail) = to.as_chunks_mut::<{ 2 * LANES }>();
    for (block, to) in blocks.iter().zip(to_blocks) {
        let [low, high] = block.as_chunks::<LANES>().0 else {
            unreachable!("two halves")
        };
        // SAFETY: 32 bytes become one register of bf16.
        unsafe {
            let words = _mm512_cvtne2ps_pbh(bytes_to_floats(high), bytes_to_floats(low));
            let words = transmute::<__m512bh, __m512i>(words);
            _mm512_storeu_si512(to.as_mut_ptr().cast(), words);
        }
    }
    for (to, &byte) in to_tail.iter_mut().zip(tail) {
        *to = bf16::from_byte(byte);
    }
}

/// Returns a mask of the first `count` of 16 lanes.
#[inline(always)]
pub(super) const fn first_lanes(count: usize) -> u16 {
    ((1u32 << count) - 1) as u16
}
