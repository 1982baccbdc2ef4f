//! Portable code for processors without the other instruction sets. The compiler vectorises it as far as it can.

use half::bf16;

use super::{
    element::{Element, Rounding},
    simd::{LANES, Loop, RawTile, Simd},
    vector::{Sums, Vector, compute_sizes},
};

#[derive(Clone, Copy)]
pub(crate) struct F32;

/// bf16 operands in pairs, multiplied as f32.
#[derive(Clone, Copy)]
pub(crate) struct Bf16;

macro_rules! simd {
    ($simd:ident, $element:ty) => {
        impl Rounding for $simd {}

        #[allow(unsafe_code, reason = "tiles are read and written through pointers")]
        impl Simd for $simd {
            type Element = $element;
            const VECS_MAX: usize = 1;

            fn rows_max(_: usize) -> usize {
                4
            }

            unsafe fn compute(self, tile: &RawTile<$element>, rows: usize, vecs: usize) {
                // SAFETY: no special instruction is needed; the caller guarantees the rest.
                compute_sizes!(Self, tile, rows, vecs; 1: 1 2 3 4;);
            }

            #[inline(always)]
            fn vectorize<W: Loop>(self, work: W) {
                work.run()
            }
        }

        // SAFETY: reads and writes use addresses that the caller guarantees.
        #[allow(unsafe_code, reason = "tiles are read and written through pointers")]
        impl Vector for $simd {
            type Element = $element;
            type Sums = [f32; LANES];
            type Operand = [[$element; <$element>::DEPTH]; LANES];

            #[inline(always)]
            unsafe fn load_row(at: *const $element) -> Self::Operand {
                unsafe { [at.cast::<[$element; <$element>::DEPTH]>().read_unaligned(); LANES] }
            }

            #[inline(always)]
            unsafe fn load_columns(at: *const $element) -> Self::Operand {
                unsafe { at.cast::<Self::Operand>().read_unaligned() }
            }

            #[inline(always)]
            unsafe fn mul_add(
                mut sums: Self::Sums,
                row: Self::Operand,
                columns: Self::Operand,
            ) -> Self::Sums {
                for ((sum, row), columns) in sums.iter_mut().zip(row).zip(columns) {
                    for (row, column) in row.into_iter().zip(columns) {
                        *sum += row.value() * column.value();
                    }
                }
                sums
            }
        }
    };
}

// SAFETY: writes use addresses that the caller guarantees.
#[allow(unsafe_code, reason = "tiles are read and written through pointers")]
impl Sums for [f32; LANES] {
    #[inline(always)]
    unsafe fn zero() -> Self {
        [0.0; LANES]
    }

    #[inline(always)]
    unsafe fn write(self, at: *mut f32, count: usize, add: bool) {
        for (index, sum) in self.into_iter().take(count).enumerate() {
            unsafe {
                let at = at.add(index);
                *at = if add { *at + sum } else { sum };
            }
        }
    }
}

simd!(F32, f32);
simd!(Bf16, bf16);
