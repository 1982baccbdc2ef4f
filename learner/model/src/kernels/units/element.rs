//! What operands of products are stored as: f32, or bf16 in pairs along the sum.
//! It multiplies nothing.

use half::bf16;

use crate::kernels::buffer::Pooled;

/// A stored scalar of an operand.
pub(crate) trait Element: Pooled + Send + Sync + std::fmt::Debug {
    /// Neighbours along the sum that are stored together, and multiplied in one step.
    const DEPTH: usize;

    /// What products of bytes stored by [`Element::of_byte`] are multiplied by, to be products of bytes / 255.
    const BYTE_SCALE: f32;

    /// The nearest element, ties to even.
    fn of(value: f32) -> Self;

    /// A pixel: times [`Element::BYTE_SCALE`] it is the byte / 255.
    fn of_byte(byte: u8) -> Self;

    /// The scalar, exactly.
    fn value(self) -> f32;

    /// Stores `DEPTH` rows that follow each other along the sum: `step` [columns, DEPTH], with 0 for what the rows do not have.
    /// `second` is for a depth of 2.
    fn join(first: &[f32], second: &[f32], step: &mut [Self]);

    /// Scalars that need no rounding, as they are.
    fn in_place(values: &[f32]) -> Option<&[Self]>;
}

impl Element for f32 {
    const DEPTH: usize = 1;
    const BYTE_SCALE: f32 = 1.0;

    #[inline(always)]
    fn of(value: f32) -> Self {
        value
    }

    #[inline(always)]
    fn of_byte(byte: u8) -> Self {
        Self::from(byte) * (1.0 / 255.0)
    }

    #[inline(always)]
    fn value(self) -> f32 {
        self
    }

    #[inline(always)]
    fn join(first: &[f32], _: &[f32], step: &mut [Self]) {
        let (begin, end) = step.split_at_mut(first.len());
        begin.copy_from_slice(first);
        end.fill(0.0);
    }

    fn in_place(values: &[f32]) -> Option<&[Self]> {
        Some(values)
    }
}

impl Element for bf16 {
    const DEPTH: usize = 2;
    /// Every byte is a bf16, so that pixels lose nothing if they are scaled after the product.
    const BYTE_SCALE: f32 = 1.0 / 255.0;

    /// As `bf16::from_f32`, without its branch, so that loops over it use the unit's registers.
    #[inline(always)]
    fn of(value: f32) -> Self {
        let bits = value.to_bits();
        let nearest = (bits.wrapping_add(0x7fff + ((bits >> 16) & 1)) >> 16) as u16;
        // A NaN's lower bits could carry into its sign, or be all that tells it from an infinity.
        let nan = (bits >> 16) as u16 | 0x40;
        Self::from_bits(if value.is_nan() { nan } else { nearest })
    }

    #[inline(always)]
    fn of_byte(byte: u8) -> Self {
        Self::from_bits((f32::from(byte).to_bits() >> 16) as u16)
    }

    #[inline(always)]
    fn value(self) -> f32 {
        f32::from_bits(u32::from(self.to_bits()) << 16)
    }

    #[inline(always)]
    fn join(first: &[f32], second: &[f32], step: &mut [Self]) {
        let (begin, end) = step.split_at_mut(first.len() * 2);
        if second.is_empty() {
            for (pair, &first) in begin.chunks_exact_mut(2).zip(first) {
                (pair[0], pair[1]) = (Self::of(first), Self::default());
            }
        } else {
            for ((pair, &first), &second) in begin.chunks_exact_mut(2).zip(first).zip(second) {
                (pair[0], pair[1]) = (Self::of(first), Self::of(second));
            }
        }
        end.fill(Self::default());
    }

    fn in_place(_: &[f32]) -> Option<&[Self]> {
        None
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rounding_is_to_the_nearest_and_keeps_what_is_not_finite() {
        let mut bits = 1u32;
        for _ in 0..1_000_000 {
            // A full-period walk over the float space.
            bits = bits.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            let value = f32::from_bits(bits);
            let (got, wanted) = (<bf16 as Element>::of(value), bf16::from_f32(value));
            assert_eq!(got.is_nan(), wanted.is_nan(), "{bits:#x}");
            assert!(
                value.is_nan() || got == wanted,
                "{value:e}: {got}, {wanted}"
            );
        }
        for value in [0.0, -0.0, f32::MAX, f32::INFINITY, f32::NEG_INFINITY, 1e-45] {
            assert_eq!(<bf16 as Element>::of(value), bf16::from_f32(value));
        }
        assert!(<bf16 as Element>::of(f32::from_bits(0x7f80_0001)).is_nan());
        assert!(<bf16 as Element>::of(f32::from_bits(0xffff_ffff)).is_nan());
    }

    #[test]
    fn bytes_are_exact() {
        for byte in 0..=255 {
            assert_eq!(<bf16 as Element>::of_byte(byte).value(), f32::from(byte));
            assert_eq!(
                <f32 as Element>::of_byte(byte),
                f32::from(byte) * (1.0 / 255.0)
            );
        }
    }
}
