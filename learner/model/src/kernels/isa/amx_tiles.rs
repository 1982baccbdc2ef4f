//! AMX's tile registers, as a trait: what holds operands and sums, and the instructions that multiply them.
//! It cuts no product into tiles.
#![allow(unsafe_code, reason = "instructions of one kind of processor")]
#![cfg(target_arch = "x86_64")]

use std::arch::asm;
use std::cell::Cell;

use half::bf16;

use super::simd::LANES;

/// Steps, which are pairs of bf16, in a row of a tile register: 64 bytes.
pub(super) const STEPS: usize = 16;
pub(super) const ROWS: usize = 16;
/// Tile registers that hold sums.
pub(super) const SUMS: usize = 4;

/// Eight tile registers: four of sums, and a left and a right operand, each twice: for whole runs of `STEPS`, and for what is left.
///
/// # Safety
/// Of all methods: `configure` came before, pointers may be read or written as the sizes given to it say, and the processor has
/// what the implementation needs.
pub(super) trait Tiles {
    /// Sizes: left operands [rows, steps], right ones [steps, 16], sums [rows, 16]; `tail` steps in the second pair of operands, 0 if
    /// there are none. Sums are 0 afterwards.
    unsafe fn configure(&mut self, rows: usize, tail: usize);
    /// Strides are in bytes.
    unsafe fn load_left(&mut self, at: *const bf16, stride: usize, tail: bool);
    unsafe fn load_right(&mut self, at: *const bf16, stride: usize, tail: bool);
    /// Adds left times right to the sums of this number.
    unsafe fn dot(&mut self, sums: usize, tail: bool);
    /// Sums that begin with what is at `at`.
    unsafe fn load_sums(&mut self, sums: usize, at: *const f32, stride: usize);
    unsafe fn store(&mut self, sums: usize, at: *mut f32, stride: usize);
}

pub(super) struct Hardware;

thread_local! {
    /// Rows and tail that the thread's registers are configured for, as that takes as long as ten products.
    static SIZES: Cell<(usize, usize)> = const { Cell::new((0, 0)) };
}

/// What `ldtilecfg` reads.
#[repr(C, align(64))]
struct TileConfig {
    palette: u8,
    start_row: u8,
    reserved: [u8; 14],
    row_bytes: [u16; 16],
    rows: [u8; 16],
}

macro_rules! load {
    ($register:tt, $at:expr, $stride:expr) => {
        asm!(
            concat!("tileloadd ", $register, ", [{at} + {stride} * 1]"),
            at = in(reg) $at,
            stride = in(reg) $stride,
            out($register) _,
            options(nostack, readonly)
        )
    };
}

macro_rules! dot {
    ($sums:tt, $left:tt, $right:tt) => {
        asm!(
            concat!("tdpbf16ps ", $sums, ", ", $left, ", ", $right),
            out($sums) _,
            options(nostack, nomem)
        )
    };
}

macro_rules! store {
    ($sums:literal, $at:expr, $stride:expr) => {
        asm!(
            concat!("tilestored [{at} + {stride} * 1], ", $sums),
            at = in(reg) $at,
            stride = in(reg) $stride,
            options(nostack)
        )
    };
}

// SAFETY of all: the caller answers for pointers and processor. Between the calls nothing else uses tile registers: compilers
// do not without being told to, and every user of this module configures them anew.
impl Tiles for Hardware {
    unsafe fn configure(&mut self, rows: usize, tail: usize) {
        if SIZES.replace((rows, tail)) == (rows, tail) {
            unsafe {
                asm!("tilezero tmm0", "tilezero tmm1", "tilezero tmm2", "tilezero tmm3", options(nostack, nomem),
                    out("tmm0") _, out("tmm1") _, out("tmm2") _, out("tmm3") _);
            }
            return;
        }
        let mut config = TileConfig {
            palette: 1,
            start_row: 0,
            reserved: [0; 14],
            row_bytes: [0; 16],
            rows: [0; 16],
        };
        let mut set = |tile: usize, rows: usize, columns: usize| {
            // At most 16 and 64.
            (config.rows[tile], config.row_bytes[tile]) = (rows as u8, (columns * 4) as u16);
        };
        for sums in 0..SUMS {
            set(sums, rows, LANES);
        }
        set(4, rows, STEPS);
        set(5, STEPS, LANES);
        if tail > 0 {
            set(6, rows, tail);
            set(7, tail, LANES);
        }
        unsafe {
            asm!("ldtilecfg [{config}]", config = in(reg) &raw const config, options(nostack, readonly),
                out("tmm0") _, out("tmm1") _, out("tmm2") _, out("tmm3") _,
                out("tmm4") _, out("tmm5") _, out("tmm6") _, out("tmm7") _);
        }
    }

    #[inline(always)]
    unsafe fn load_left(&mut self, at: *const bf16, stride: usize, tail: bool) {
        unsafe {
            match tail {
                false => load!("tmm4", at, stride),
                true => load!("tmm6", at, stride),
            }
        }
    }

    #[inline(always)]
    unsafe fn load_right(&mut self, at: *const bf16, stride: usize, tail: bool) {
        unsafe {
            match tail {
                false => load!("tmm5", at, stride),
                true => load!("tmm7", at, stride),
            }
        }
    }

    #[inline(always)]
    unsafe fn dot(&mut self, sums: usize, tail: bool) {
        unsafe {
            match (sums, tail) {
                (0, false) => dot!("tmm0", "tmm4", "tmm5"),
                (1, false) => dot!("tmm1", "tmm4", "tmm5"),
                (2, false) => dot!("tmm2", "tmm4", "tmm5"),
                (_, false) => dot!("tmm3", "tmm4", "tmm5"),
                (0, true) => dot!("tmm0", "tmm6", "tmm7"),
                (1, true) => dot!("tmm1", "tmm6", "tmm7"),
                (2, true) => dot!("tmm2", "tmm6", "tmm7"),
                (_, true) => dot!("tmm3", "tmm6", "tmm7"),
            }
        }
    }

    #[inline(always)]
    unsafe fn load_sums(&mut self, sums: usize, at: *const f32, stride: usize) {
        unsafe {
            match sums {
                0 => load!("tmm0", at, stride),
                1 => load!("tmm1", at, stride),
                2 => load!("tmm2", at, stride),
                _ => load!("tmm3", at, stride),
            }
        }
    }

    #[inline(always)]
    unsafe fn store(&mut self, sums: usize, at: *mut f32, stride: usize) {
        unsafe {
            match sums {
                0 => store!("tmm0", at, stride),
                1 => store!("tmm1", at, stride),
                2 => store!("tmm2", at, stride),
                _ => store!("tmm3", at, stride),
            }
        }
    }
}
