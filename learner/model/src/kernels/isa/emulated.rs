//! AMX's tile registers emulated in plain Rust, for tests on any processor.
#![allow(unsafe_code, reason = "tiles are read and written through pointers")]
#![cfg(all(test, target_arch = "x86_64"))]

use half::bf16;

use super::{
    amx::{ROWS_MAX, compute},
    amx_tiles::{ACCUMULATORS, TILE_ROWS, TILE_STEPS, TileRegisters},
    element::Rounding,
    simd::{LANES, Loop, RawTile, Simd},
};

#[derive(Clone, Copy, Default)]
struct EmulatedTiles {
    rows: usize,
    tail: usize,
    left: [[[u32; TILE_STEPS]; TILE_ROWS]; 2],
    right: [[[u32; LANES]; TILE_STEPS]; 2],
    sums: [[[f32; LANES]; TILE_ROWS]; ACCUMULATORS],
}

fn pair(pair: u32) -> [f32; 2] {
    [
        f32::from_bits(pair << 16),
        f32::from_bits(pair & 0xffff_0000),
    ]
}

impl EmulatedTiles {
    const fn steps(&self, tail: bool) -> usize {
        if tail { self.tail } else { TILE_STEPS }
    }
}

/// Loads rows of `cols` values of 4 bytes each, `stride` bytes apart.
unsafe fn load<T, const N: usize>(at: *const T, stride: usize, to: &mut [[T; N]], cols: usize) {
    for (row, to) in to.iter_mut().enumerate() {
        for (col, to) in to.iter_mut().enumerate().take(cols) {
            let at = at.cast::<u8>().wrapping_add(row * stride + col * 4);
            *to = unsafe { at.cast::<T>().read_unaligned() };
        }
    }
}

impl TileRegisters for EmulatedTiles {
    unsafe fn configure(&mut self, rows: usize, tail: usize) {
        assert!(rows <= TILE_ROWS && tail < TILE_STEPS);
        *self = Self {
            rows,
            tail,
            ..Self::default()
        };
    }

    unsafe fn load_left(&mut self, at: *const bf16, stride: usize, tail: bool) {
        let steps = self.steps(tail);
        let to = &mut self.left[usize::from(tail)][..self.rows];
        unsafe { load(at.cast(), stride, to, steps) }
    }

    unsafe fn load_right(&mut self, at: *const bf16, stride: usize, tail: bool) {
        let steps = self.steps(tail);
        let to = &mut self.right[usize::from(tail)][..steps];
        unsafe { load(at.cast(), stride, to, LANES) }
    }

    unsafe fn dot(&mut self, sums: usize, tail: bool) {
        let (operands, steps) = (usize::from(tail), self.steps(tail));
        for row in 0..self.rows {
            for step in 0..steps {
                let left = pair(self.left[operands][row][step]);
                for col in 0..LANES {
                    let right = pair(self.right[operands][step][col]);
                    self.sums[sums][row][col] += left[0] * right[0] + left[1] * right[1];
                }
            }
        }
    }

    unsafe fn load_sums(&mut self, sums: usize, at: *const f32, stride: usize) {
        unsafe { load(at, stride, &mut self.sums[sums][..self.rows], LANES) }
    }

    unsafe fn store(&mut self, sums: usize, at: *mut f32, stride: usize) {
        for row in 0..self.rows {
            for col in 0..LANES {
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
    const VECS_MAX: usize = ACCUMULATORS;
    const LEFT_STEPS_ADJACENT: bool = true;

    fn rows_max(_: usize) -> usize {
        ROWS_MAX
    }

    unsafe fn compute(self, tile: &RawTile<bf16>, rows: usize, vecs: usize) {
        unsafe { compute(self, &mut EmulatedTiles::default(), tile, rows, vecs) }
    }

    fn vectorize<W: Loop>(self, work: W) {
        work.run()
    }
}
