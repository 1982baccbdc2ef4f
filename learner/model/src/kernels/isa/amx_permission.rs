//! Detects AMX for bf16, and asks the kernel for permission to use its registers.
//! This module knows no tiles.
#![allow(unsafe_code, reason = "a system call")]
#![cfg(target_arch = "x86_64")]

use std::arch::asm;

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
