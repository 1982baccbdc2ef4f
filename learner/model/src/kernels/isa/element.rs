//! The types in which operands of products are stored: f32, or bf16 in pairs along the reduction axis.
//! This module multiplies nothing.

use half::bf16;

use crate::kernels::buffer::Pooled;

/// Columns of one register, on every instruction set.
pub(crate) const LANES: usize = 16;

/// Instructions that round scalars and interleave them in pairs.
pub(crate) trait Rounding: Copy {
    /// Rounds `values` to the nearest bf16, ties to even, into the first elements of `to`. A subnormal may
    /// become a 0 of its sign, because products with these instructions treat it as 0.
    #[inline(always)]
    fn round(self, values: &[f32], to: &mut [bf16]) {
        for (to, &value) in to.iter_mut().zip(values) {
            *to = bf16::rounded(value);
        }
    }

    /// Rounds two rows as [`Rounding::round`] and interleaves them: `pairs` [columns, 2].
    #[inline(always)]
    fn round_pairs(self, first: &[f32], second: &[f32], pairs: &mut [bf16]) {
        for ((pair, &first), &second) in pairs.chunks_exact_mut(2).zip(first).zip(second) {
            (pair[0], pair[1]) = (bf16::rounded(first), bf16::rounded(second));
        }
    }

    /// Interleaves two rows of bf16 of equal length: `pairs` [columns, 2].
    #[inline(always)]
    fn pair(self, first: &[bf16], second: &[bf16], pairs: &mut [bf16]) {
        for ((pair, &first), &second) in pairs.chunks_exact_mut(2).zip(first).zip(second) {
            (pair[0], pair[1]) = (first, second);
        }
    }

    /// Converts pixels as [`Element::from_byte`], into the first elements of `to`.
    #[inline(always)]
    fn convert_bytes(self, bytes: &[u8], to: &mut [bf16]) {
        for (to, &byte) in to.iter_mut().zip(bytes) {
            *to = bf16::from_byte(byte);
        }
    }
}

pub(crate) trait Element: Pooled + Send + Sync + std::fmt::Debug {
    /// Neighbouring scalars along the reduction axis that are stored together and multiplied in one step.
    const DEPTH: usize;

    /// The factor that turns products of bytes stored by [`Element::from_byte`] into products of byte / 255.
    const BYTE_SCALE: f32;

    /// Rounds to the nearest element, ties to even.
    fn rounded(value: f32) -> Self;

    /// Rounds `values` as [`Element::rounded`] into `to`, which has the same length, with the instructions of `rounding`.
    fn store<R: Rounding>(rounding: R, values: &[f32], to: &mut [Self]);

    /// Converts a pixel. The result times [`Element::BYTE_SCALE`] is byte / 255.
    fn from_byte(byte: u8) -> Self;

    fn value(self) -> f32;

    /// Interleaves `DEPTH` rows that follow each other along the reduction axis: `step` [columns, DEPTH],
    /// with 0 where the rows end. `second` is used only if `DEPTH` is 2.
    fn interleave<R: Rounding>(rounding: R, first: &[f32], second: &[f32], step: &mut [Self]);

    /// Rounds `values` [`LANES`, DEPTH] to `LANES` steps of 32 bits each.
    fn round_steps<R: Rounding>(rounding: R, values: &[f32], steps: &mut [u32; LANES]);

    /// Converts pixels as [`Element::from_byte`], into the first elements of `to`.
    fn store_bytes<R: Rounding>(rounding: R, bytes: &[u8], to: &mut [Self]);

    /// Copies `values`. If `DEPTH` is 2, each is paired with the one `shift` further, or with 0 beyond the end: `steps` [values, DEPTH].
    fn store_steps<R: Rounding>(rounding: R, values: &[Self], shift: usize, steps: &mut [Self]);

    /// Packs the scalars of a step [DEPTH] into 32 bits.
    fn pack(step: &[Self]) -> u32;

    /// Unpacks the scalars of a step into `step` [DEPTH].
    fn unpack(bits: u32, step: &mut [Self]);

    /// Returns `values` themselves if they need no rounding.
    fn in_place(_values: &[f32]) -> Option<&[Self]> {
        None
    }
}

impl Element for f32 {
    const DEPTH: usize = 1;
    const BYTE_SCALE: f32 = 1.0;

    #[inline(always)]
    fn rounded(value: f32) -> Self {
        value
    }

    #[inline(always)]
    fn from_byte(byte: u8) -> Self {
        Self::from(byte) * (1.0 / 255.0)
    }

    #[inline(always)]
    fn value(self) -> f32 {
        self
    }

    #[inline(always)]
    fn store<R: Rounding>(_: R, values: &[f32], to: &mut [Self]) {
        to.copy_from_slice(values);
    }

    #[inline(always)]
    fn interleave<R: Rounding>(_: R, first: &[f32], _: &[f32], step: &mut [Self]) {
        let (begin, end) = step.split_at_mut(first.len());
        begin.copy_from_slice(first);
        end.fill(0.0);
    }

    #[inline(always)]
    fn round_steps<R: Rounding>(_: R, values: &[f32], steps: &mut [u32; LANES]) {
        for (step, value) in steps.iter_mut().zip(values) {
            *step = value.to_bits();
        }
    }

    #[inline(always)]
    fn store_bytes<R: Rounding>(_: R, bytes: &[u8], to: &mut [Self]) {
        for (to, &byte) in to.iter_mut().zip(bytes) {
            *to = Self::from_byte(byte);
        }
    }

    #[inline(always)]
    fn store_steps<R: Rounding>(_: R, values: &[Self], _: usize, steps: &mut [Self]) {
        steps.copy_from_slice(values);
    }

    #[inline(always)]
    fn pack(step: &[Self]) -> u32 {
        step[0].to_bits()
    }

    #[inline(always)]
    fn unpack(bits: u32, step: &mut [Self]) {
        step[0] = Self::from_bits(bits);
    }

    fn in_place(values: &[f32]) -> Option<&[Self]> {
        Some(values)
    }
}

impl Element for bf16 {
    const DEPTH: usize = 2;
    /// Every byte is exact in bf16, so pixels lose nothing if they are scaled after the product.
    const BYTE_SCALE: f32 = 1.0 / 255.0;

    /// As `bf16::from_f32`, but without a branch, so that loops over it are vectorised.
    #[inline(always)]
    fn rounded(value: f32) -> Self {
        let bits = value.to_bits();
        let nearest = (bits.wrapping_add(0x7fff + ((bits >> 16) & 1)) >> 16) as u16;
        // A NaN's lower bits could carry into its sign, or be all that tells it from an infinity.
        let nan = (bits >> 16) as u16 | 0x40;
        Self::from_bits(if value.is_nan() { nan } else { nearest })
    }

    #[inline(always)]
    fn from_byte(byte: u8) -> Self {
        Self::from_bits((f32::from(byte).to_bits() >> 16) as u16)
    }

    #[inline(always)]
    fn value(self) -> f32 {
        f32::from_bits(u32::from(self.to_bits()) << 16)
    }

    #[inline(always)]
    fn store<R: Rounding>(rounding: R, values: &[f32], to: &mut [Self]) {
        rounding.round(values, to);
    }

    #[inline(always)]
    fn interleave<R: Rounding>(rounding: R, first: &[f32], second: &[f32], step: &mut [Self]) {
        let (begin, end) = step.split_at_mut(first.len() * 2);
        if second.is_empty() {
            for (pair, &first) in begin.chunks_exact_mut(2).zip(first) {
                (pair[0], pair[1]) = (Self::rounded(first), Self::default());
            }
        } else {
            rounding.round_pairs(first, second, begin);
        }
        end.fill(Self::default());
    }

    #[inline(always)]
    fn round_steps<R: Rounding>(rounding: R, values: &[f32], steps: &mut [u32; LANES]) {
        let mut rounded = [Self::default(); 2 * LANES];
        rounding.round(values, &mut rounded);
        for (step, pair) in steps.iter_mut().zip(rounded.chunks_exact(2)) {
            *step = Self::pack(pair);
        }
    }

    #[inline(always)]
    fn store_bytes<R: Rounding>(rounding: R, bytes: &[u8], to: &mut [Self]) {
        rounding.convert_bytes(bytes, to);
    }

    #[inline(always)]
    fn store_steps<R: Rounding>(rounding: R, values: &[Self], shift: usize, steps: &mut [Self]) {
        let shifted = values.get(shift..).unwrap_or_default();
        let (begin, end) = values.split_at(shifted.len());
        let (both, one) = steps.split_at_mut(shifted.len() * 2);
        rounding.pair(begin, shifted, both);
        for (pair, &value) in one.chunks_exact_mut(2).zip(end) {
            (pair[0], pair[1]) = (value, Self::default());
        }
    }

    #[inline(always)]
    fn pack(step: &[Self]) -> u32 {
        u32::from(step[0].to_bits()) | u32::from(step[1].to_bits()) << 16
    }

    #[inline(always)]
    fn unpack(bits: u32, step: &mut [Self]) {
        step[0] = Self::from_bits(bits as u16);
        step[1] = Self::from_bits((bits >> 16) as u16);
    }
}
