//! AMX's tile registers as a trait: they hold operands and accumulators, and instructions multiply them. Also the permission to use them.
//! This module does not cut products into tiles.
#![allow(unsafe_code, reason = "instructions of one kind of processor")]
#![cfg(target_arch = "x86_64")]

use std::arch::asm;
use std::cell::Cell;

use half::bf16;

use super::simd::LANES;

/// Steps, which are pairs of bf16, in a row of a tile register: 64 bytes.
pub(super) const TILE_STEPS: usize = 16;
pub(super) const TILE_ROWS: usize = 16;
/// The number of tile registers that serve as accumulators.
pub(super) const ACCUMULATORS: usize = 4;

/// Eight tile registers: four accumulators, and a left and a right operand, each twice: for whole rows and for the remaining steps.
///
/// # Safety
/// For all methods: `configure` was called before, pointers may be read or written for the sizes given to it,
/// and the processor has the instructions that the implementation uses.
pub(super) trait TileRegisters {
    /// Sets the sizes: left operands [rows, steps], right ones [steps, 16], accumulators [rows, 16]. The
    /// second pair of operands has `tail` steps, 0 if there are none. The accumulators are 0 afterwards.
    unsafe fn configure(&mut self, rows: usize, tail: usize);
    /// Loads a left operand. Strides are in bytes.
    unsafe fn load_left(&mut self, at: *const bf16, stride: usize, tail: bool);
    unsafe fn load_right(&mut self, at: *const bf16, stride: usize, tail: bool);
    /// Adds left times right to the accumulator with this index.
    unsafe fn dot(&mut self, sums: usize, tail: bool);
    /// Sets an accumulator to the values at `at`.
    unsafe fn load_sums(&mut self, sums: usize, at: *const f32, stride: usize);
    unsafe fn store(&mut self, sums: usize, at: *mut f32, stride: usize);
}

pub(super) struct HardwareTiles;

thread_local! {
    /// The rows and tail that this thread's registers are configured for. Configuring takes as long as ten products.
    static CONFIGURED: Cell<(usize, usize)> = const { Cell::new((0, 0)) };
}

/// The operand of `ldtilecfg`.
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

// SAFETY for all methods: the caller guarantees the pointers and the processor. Between the calls nothing else uses
// tile registers: compilers use them only when told to, and every user of this module configures them again.
impl TileRegisters for HardwareTiles {
    unsafe fn configure(&mut self, rows: usize, tail: usize) {
        if CONFIGURED.replace((rows, tail)) == (rows, tail) {
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
            // At most 16 rows and 64 bytes.
            (config.rows[tile], config.row_bytes[tile]) = (rows as u8, (columns * 4) as u16);
        };
        for sums in 0..ACCUMULATORS {
            set(sums, rows, LANES);
        }
        set(4, rows, TILE_STEPS);
        set(5, TILE_STEPS, LANES);
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

/// Reads CPUID leaf 7: EDX bit 22 is AMX_BF16, bit 24 AMX_TILE. `request_permission` checks that the operating system supports tiles.
#[allow(
    unused_unsafe,
    reason = "the instruction is unsafe in Rust 1.90 and safe in later ones"
)]
pub(super) fn has_amx_bf16() -> bool {
    use std::arch::x86_64::{__cpuid, __cpuid_count};
    // SAFETY: every processor of this architecture has the instruction.
    let leaf_7 = unsafe { (__cpuid(0).eax >= 7).then(|| __cpuid_count(7, 0)) };
    leaf_7.is_some_and(|it| it.edx & (1 << 22) != 0 && it.edx & (1 << 24) != 0)
}

/// Asks Linux for the 8 KiB of tile state (`arch_prctl(ARCH_REQ_XCOMP_PERM, XFEATURE_XTILEDATA)`), for all threads.
#[cfg(target_os = "linux")]
pub(super) fn request_permission() -> bool {
    const ARCH_PRCTL: i64 = 158;
    const ARCH_REQ_XCOMP_PERM: i64 = 0x1023;
    const XTILEDATA: i64 = 18;
    let result: i64;
    // SAFETY: a system call with two numbers, which touches no memory; it clobbers rcx and r11.
    unsafe {
        asm!(
            "syscall",
            inlateout("rax") ARCH_PRCTL => result,
            in("rdi") ARCH_REQ_XCOMP_PERM,
            in("rsi") XTILEDATA,
            lateout("rcx") _,
            lateout("r11") _,
            options(nostack)
        );
    }
    result == 0
}

#[cfg(not(target_os = "linux"))]
pub(super) fn request_permission() -> bool {
    false
}
