//! Tiles in plain Rust, which do what AMX's instructions do: for tests on any processor.
#![allow(unsafe_code, reason = "tiles are read and written through pointers")]
#![cfg(all(test, target_arch = "x86_64"))]

use half::bf16;

use super::{
    amx::{ROWS, ROWS_MAX, STEPS, SUMS, Tiles, compute},
    element::Rounding,
    simd::{LANES, Loop, RawTile, Simd},
};

#[derive(Clone, Copy, Default)]
struct Registers {
    rows: usize,
    cols: usize,
    tail: usize,
    left: [[[u32; STEPS]; ROWS]; 2],
    sums: [[[f32; LANES]; ROWS]; SUMS],
}

fn pair(pair: u32) -> [f32; 2] {
    [
        f32::from_bits(pair << 16),
        f32::from_bits(pair & 0xffff_0000),
    ]
}

impl Tiles for Registers {
    unsafe fn configure(&mut self, rows: usize, cols: usize, tail: usize) {
        assert!(rows <= ROWS && cols <= LANES && tail < STEPS);
        *self = Self {
            rows,
            cols,
            tail,
            ..Self::default()
        };
    }

    unsafe fn load_left(&mut self, at: *const bf16, stride: usize, tail: bool) {
        let steps = if tail { self.tail } else { STEPS };
        for row in 0..self.rows {
            for step in 0..steps {
                let at = at.cast::<u8>().wrapping_add(row * stride + step * 4);
                self.left[usize::from(tail)][row][step] =
                    unsafe { at.cast::<u32>().read_unaligned() };
            }
        }
    }

    unsafe fn dot(&mut self, sums: usize, right: *const bf16, stride: usize, tail: bool) {
        let steps = if tail { self.tail } else { STEPS };
        for row in 0..self.rows {
            for step in 0..steps {
                let left = pair(self.left[usize::from(tail)][row][step]);
                for col in 0..self.cols {
                    let at = right.cast::<u8>().wrapping_add(step * stride + col * 4);
                    let right = pair(unsafe { at.cast::<u32>().read_unaligned() });
                    self.sums[sums][row][col] += left[0] * right[0] + left[1] * right[1];
                }
            }
        }
    }

    unsafe fn store(&mut self, sums: usize, at: *mut f32, stride: usize) {
        for row in 0..self.rows {
            for col in 0..self.cols {
                let at = at.cast::<u8>().wrapping_add(row * stride + col * 4);
                unsafe { at.cast::<f32>().write_unaligned(self.sums[sums][row][col]) };
            }
        }
    }
}

#[derive(Clone, Copy)]
pub(crate) struct EmulatedAmx;

impl Rounding for EmulatedAmx {}

impl Simd for EmulatedAmx {
    type Element = bf16;
    const VECS_MAX: usize = SUMS;
    const LEFT_STEPS_ADJOIN: bool = true;

    fn rows_max(_: usize) -> usize {
        ROWS_MAX
    }

    unsafe fn compute(self, tile: &RawTile<bf16>, rows: usize, vecs: usize) {
        unsafe { compute(self, &mut Registers::default(), tile, rows, vecs) }
    }

    fn vectorize<W: Loop>(self, work: W) {
        work.run()
    }
}
