//! AMX: products of whole tiles of bf16, up to 16 rows by 16 columns by 32 terms an instruction.
//! The arithmetic of the tiles is a trait, so that what cuts products into tiles is tested on processors without them.
#![allow(unsafe_code, reason = "instructions of one kind of processor")]
#![cfg(target_arch = "x86_64")]

use std::arch::asm;
use std::sync::OnceLock;

use half::bf16;

use super::amx_permission::{granted, has_amx_bf16};
use super::avx512::{Bf16, bf16_rounding};
use super::avx512_rounding;
use super::element::Rounding;
use super::simd::{LANES, Loop, Mode, RawTile, Simd};

/// Steps, which are pairs of bf16, in a row of a tile register: 64 bytes.
pub(super) const STEPS: usize = 16;
pub(super) const ROWS: usize = 16;
/// Tile registers that hold sums.
pub(super) const SUMS: usize = 4;

/// Multiplies two small matrices whose product is exact in either order of the sum, in both ways that tiles are used, and looks at
/// the result: a virtual machine may promise tiles that it does not keep.
fn multiplies_right(simd: Bf16) -> bool {
    const K: usize = 2 * (STEPS + 3);
    let value = |at: usize| bf16::from_f32((at % 5) as f32 - 2.0);
    let (left, panel): (Vec<_>, Vec<_>) = (
        (0..20 * K).map(value).collect(),
        (0..K * LANES).map(|at| value(at * 3)).collect(),
    );
    let mut right = true;
    for (row_stride, step) in [(K, 2), (2, 40)] {
        let mut out = [0f32; 20 * LANES];
        let tile = RawTile {
            left: left.as_ptr(),
            row_stride,
            step,
            steps: K / 2,
            run_stride: 0,
            runs: 1,
            panel: panel.as_ptr(),
            out: out.as_mut_ptr(),
            out_stride: LANES,
            cols: LANES,
            mode: Mode::Replace,
        };
        // SAFETY: `Amx::new` has found the instructions and been granted the registers; the sizes are those of the vectors.
        unsafe { compute(simd, &mut Hardware, &tile, 20, 1) };
        for (at, &got) in out.iter().enumerate() {
            let (row, col) = (at / LANES, at % LANES);
            let terms = (0..K).map(|k| {
                let left = left[row * row_stride + k / 2 * step + k % 2];
                left.to_f32() * panel[(k / 2 * LANES + col) * 2 + k % 2].to_f32()
            });
            right &= got == terms.sum::<f32>();
        }
    }
    right
}

/// Eight tile registers: four of sums, and a left and a right operand, each twice: for whole runs of `STEPS`, and for what is left.
///
/// # Safety
/// Of all methods: `configure` came before, pointers may be read or written as the sizes given to it say, and the processor has
/// what the implementation needs.
pub(super) trait Tiles {
    /// Sizes: left operands [rows, steps], right ones [steps, cols], sums [rows, cols]; `tail` steps in the second pair of
    /// operands, 0 if there are none. Sums are 0 afterwards.
    unsafe fn configure(&mut self, rows: usize, cols: usize, tail: usize);
    unsafe fn load_left(&mut self, at: *const bf16, stride: usize, tail: bool);
    /// Adds left times right to the sums of this number. Strides are in bytes.
    unsafe fn dot(&mut self, sums: usize, right: *const bf16, stride: usize, tail: bool);
    unsafe fn store(&mut self, sums: usize, at: *mut f32, stride: usize);
}

struct Hardware;

/// What `ldtilecfg` reads.
#[repr(C, align(64))]
struct TileConfig {
    palette: u8,
    start_row: u8,
    reserved: [u8; 14],
    row_bytes: [u16; 16],
    rows: [u8; 16],
}

macro_rules! dot {
    ($sums:literal, $left:literal, $right:literal, $at:expr, $stride:expr) => {
        asm!(
            concat!("tileloadd ", $right, ", [{at} + {stride} * 1]"),
            concat!("tdpbf16ps ", $sums, ", ", $left, ", ", $right),
            at = in(reg) $at,
            stride = in(reg) $stride,
            out("tmm5") _,
            out("tmm7") _,
            options(nostack, readonly)
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
    unsafe fn configure(&mut self, rows: usize, cols: usize, tail: usize) {
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
            set(sums, rows, cols);
        }
        set(4, rows, STEPS);
        set(5, STEPS, cols);
        if tail > 0 {
            set(6, rows, tail);
            set(7, tail, cols);
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
            if tail {
                asm!("tileloadd tmm6, [{at} + {stride} * 1]", at = in(reg) at, stride = in(reg) stride,
                    out("tmm6") _, options(nostack, readonly));
            } else {
                asm!("tileloadd tmm4, [{at} + {stride} * 1]", at = in(reg) at, stride = in(reg) stride,
                    out("tmm4") _, options(nostack, readonly));
            }
        }
    }

    #[inline(always)]
    unsafe fn dot(&mut self, sums: usize, right: *const bf16, stride: usize, tail: bool) {
        unsafe {
            match (sums, tail) {
                (0, false) => dot!("tmm0", "tmm4", "tmm5", right, stride),
                (1, false) => dot!("tmm1", "tmm4", "tmm5", right, stride),
                (2, false) => dot!("tmm2", "tmm4", "tmm5", right, stride),
                (_, false) => dot!("tmm3", "tmm4", "tmm5", right, stride),
                (0, true) => dot!("tmm0", "tmm6", "tmm7", right, stride),
                (1, true) => dot!("tmm1", "tmm6", "tmm7", right, stride),
                (2, true) => dot!("tmm2", "tmm6", "tmm7", right, stride),
                (_, true) => dot!("tmm3", "tmm6", "tmm7", right, stride),
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

/// bf16 operands in pairs, on tiles.
#[derive(Clone, Copy)]
pub(crate) struct Amx(
    /// For all that is not a product: a processor with AMX's bf16 has AVX-512's.
    Bf16,
);

impl Amx {
    /// It, if this processor and kernel have AMX for bf16, and it multiplies right. Asks the kernel once for leave to use the tile
    /// registers.
    pub(super) fn new() -> Option<Self> {
        static IS_THERE: OnceLock<bool> = OnceLock::new();
        let vectors = Bf16::new()?;
        let is_there =
            IS_THERE.get_or_init(|| has_amx_bf16() && granted() && multiplies_right(vectors));
        is_there.then_some(Self(vectors))
    }
}

/// Most rows of a tile as the products are cut: four registers of them.
pub(super) const ROWS_MAX: usize = SUMS * ROWS;

bf16_rounding!(Amx);

impl Simd for Amx {
    type Element = bf16;
    const VECS_MAX: usize = SUMS;
    const LEFT_STEPS_ADJOIN: bool = true;

    fn rows_max(_: usize) -> usize {
        ROWS_MAX
    }

    unsafe fn compute(self, tile: &RawTile<bf16>, rows: usize, vecs: usize) {
        struct Work<'a>(Bf16, &'a RawTile<bf16>, usize, usize);
        impl Loop for Work<'_> {
            #[inline(always)]
            fn run(self) {
                let Self(simd, tile, rows, vecs) = self;
                // SAFETY: `Amx::new` found the instructions; the rest is the caller's.
                unsafe { compute(simd, &mut Hardware, tile, rows, vecs) }
            }
        }
        self.vectorize(Work(self.0, tile, rows, vecs));
    }

    #[inline(always)]
    fn transpose(self, block: &mut [[u32; LANES]; LANES]) {
        self.0.transpose(block);
    }

    #[inline(always)]
    fn vectorize<W: Loop>(self, work: W) {
        self.0.vectorize(work)
    }
}

/// Computes a tile of products. `simd` is for what is not one.
///
/// # Safety
/// As for `Simd::compute`, on a processor that `tiles` is for.
#[inline(always)]
pub(super) unsafe fn compute<S: Simd, T: Tiles>(
    simd: S,
    tiles: &mut T,
    tile: &RawTile<bf16>,
    rows: usize,
    vecs: usize,
) {
    // SAFETY: the caller's.
    unsafe {
        // Steps that lie side by side fill the row of a left register; else the rows do, and the product is turned round.
        if tile.step == 2 {
            by_rows(tiles, tile, rows, vecs);
        } else {
            by_columns(simd, tiles, tile, rows, vecs);
        }
    }
}

/// The product of rows whose steps lie side by side: registers of 16 rows on the left, of 16 columns on the right.
///
/// # Safety
/// As for `compute`, with a step of 2.
#[inline(always)]
unsafe fn by_rows<T: Tiles>(tiles: &mut T, tile: &RawTile<bf16>, rows: usize, vecs: usize) {
    let (whole, tail) = (tile.steps / STEPS, tile.steps % STEPS);
    let width = vecs * LANES;
    for first in (0..rows).step_by(ROWS) {
        let count = ROWS.min(rows - first);
        // SAFETY: rows, runs and steps are within the tile's, columns within its panel's.
        unsafe {
            tiles.configure(count, LANES, tail);
            for run in 0..tile.runs {
                let left = tile
                    .left
                    .add(first * tile.row_stride + run * tile.run_stride);
                let panel = tile.panel.add(run * tile.steps * width * 2);
                for part in 0..whole + usize::from(tail > 0) {
                    let in_tail = part == whole;
                    tiles.load_left(left.add(part * STEPS * 2), tile.row_stride * 2, in_tail);
                    let panel = panel.add(part * STEPS * width * 2);
                    for vec in 0..vecs {
                        tiles.dot(vec, panel.add(vec * LANES * 2), width * 4, in_tail);
                    }
                }
            }
            let mut sums = [[0; LANES]; ROWS];
            for vec in 0..vecs {
                tiles.store(vec, sums.as_mut_ptr().cast(), LANES * 4);
                write_sums(tile, (first, count), vec, &sums);
            }
        }
    }
}

/// The product of rows whose steps are apart, and which lie side by side themselves: columns of the panel on the left, turned so
/// that their steps lie side by side, and rows on the right.
///
/// # Safety
/// As for `compute`, with a row stride of 2.
#[inline(always)]
unsafe fn by_columns<S: Simd, T: Tiles>(
    simd: S,
    tiles: &mut T,
    tile: &RawTile<bf16>,
    rows: usize,
    vecs: usize,
) {
    assert!(
        tile.row_stride == 2,
        "neither steps nor rows lie side by side"
    );
    let tail = tile.steps % STEPS;
    let width = vecs * LANES;
    let whole_rows = rows / LANES * LANES;
    for (first, groups, lanes) in [
        (0, whole_rows / LANES, LANES),
        (
            whole_rows,
            usize::from(whole_rows < rows),
            rows - whole_rows,
        ),
    ] {
        if groups == 0 {
            continue;
        }
        for vec in 0..vecs {
            // SAFETY: rows, runs and steps are within the tile's, columns within its panel's.
            unsafe {
                tiles.configure(LANES, lanes, tail);
                for run in 0..tile.runs {
                    for part in 0..tile.steps.div_ceil(STEPS) {
                        let steps = STEPS.min(tile.steps - part * STEPS);
                        let step = run * tile.steps + part * STEPS;
                        let panel = tile.panel.add((step * width + vec * LANES) * 2);
                        let mut block = block_of(panel.cast(), width, steps);
                        simd.transpose(&mut block);
                        let in_tail = steps < STEPS;
                        tiles.load_left(block.as_ptr().cast(), STEPS * 4, in_tail);
                        let left = tile
                            .left
                            .add(first * 2 + run * tile.run_stride + part * STEPS * tile.step);
                        for group in 0..groups {
                            tiles.dot(group, left.add(group * LANES * 2), tile.step * 2, in_tail);
                        }
                    }
                }
                for group in 0..groups {
                    let mut sums = [[0; LANES]; LANES];
                    tiles.store(group, sums.as_mut_ptr().cast(), LANES * 4);
                    simd.transpose(&mut sums);
                    write_sums(tile, (first + group * LANES, lanes), vec, &sums);
                }
            }
        }
    }
}

/// The first 16 columns of `steps` rows of a panel [step, width], in pairs.
///
/// # Safety
/// The panel has them.
#[inline(always)]
unsafe fn block_of(panel: *const u32, width: usize, steps: usize) -> [[u32; LANES]; STEPS] {
    let mut block = [[0; LANES]; STEPS];
    for (step, block) in block.iter_mut().enumerate().take(steps) {
        // SAFETY: the caller's; pairs of bf16 need no alignment.
        *block = unsafe {
            panel
                .add(step * width)
                .cast::<[u32; LANES]>()
                .read_unaligned()
        };
    }
    block
}

/// Writes or adds the first of `sums` [row, column], the bits of f32, to the output's rows (first, count) and a register of columns.
///
/// # Safety
/// The output has them, as far as `tile.cols` goes.
#[inline(always)]
unsafe fn write_sums(
    tile: &RawTile<bf16>,
    (first, count): (usize, usize),
    vec: usize,
    sums: &[[u32; LANES]; ROWS],
) {
    let cols = tile.cols.saturating_sub(vec * LANES).min(LANES);
    if cols == 0 {
        return;
    }
    for (row, sums) in sums.iter().enumerate().take(count) {
        let at = (first + row) * tile.out_stride + vec * LANES;
        // SAFETY: the caller's; the output is exclusively borrowed by the tile.
        let out = unsafe { std::slice::from_raw_parts_mut(tile.out.add(at), cols) };
        for (out, &sum) in out.iter_mut().zip(sums) {
            let sum = f32::from_bits(sum);
            *out = match tile.mode {
                Mode::Add => *out + sum,
                Mode::Replace => sum,
            };
        }
    }
}
