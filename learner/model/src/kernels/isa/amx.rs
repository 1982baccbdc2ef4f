//! AMX: products of whole tiles of bf16, up to 16 rows by 16 columns by 32 terms an instruction.
//! The tile arithmetic is a trait, so that the code that cuts products into tiles is tested on processors without AMX.
#![allow(unsafe_code, reason = "instructions of one kind of processor")]
#![cfg(target_arch = "x86_64")]

use std::{
    mem::MaybeUninit,
    slice::{from_raw_parts, from_raw_parts_mut},
    sync::OnceLock,
};

use half::bf16;

use super::amx_tiles::{
    ACCUMULATORS, HardwareTiles, TILE_ROWS, TILE_STEPS, TileRegisters, has_amx_bf16,
    request_permission,
};
use super::avx512::{Bf16, bf16_rounding};
use super::avx512_rounding;
use super::element::Rounding;
use super::simd::{LANES, Loop, Mode, RawTile, Simd};

/// Checks two small products, exact in any order of summation, one for each layout of a left operand. A
/// virtual machine may announce tiles that do not work.
fn passes_self_test(simd: Bf16) -> bool {
    const K: usize = 2 * (TILE_STEPS + 3);
    let value = |at: usize| bf16::from_f32((at % 5) as f32 - 2.0);
    let left: Vec<_> = (0..20 * K).map(value).collect();
    let panel: Vec<_> = (0..K * LANES).map(|at| value(at * 3)).collect();
    let mut passes = true;
    for (row_stride, step_stride) in [(K, 2), (2, 40)] {
        let mut out = [0f32; 20 * LANES];
        let tile = RawTile {
            left: left.as_ptr(),
            row_stride,
            step_stride,
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
        unsafe { compute(simd, &mut HardwareTiles, &tile, 20, 1) };
        for (at, &got) in out.iter().enumerate() {
            let (row, col) = (at / LANES, at % LANES);
            let terms = (0..K).map(|k| {
                let left = left[row * row_stride + k / 2 * step_stride + k % 2];
                left.to_f32() * panel[(k / 2 * LANES + col) * 2 + k % 2].to_f32()
            });
            passes &= got == terms.sum::<f32>();
        }
    }
    passes
}

/// One row for each row of a register. No row crosses a cache line.
#[repr(align(64))]
struct AlignedBlock<T>([[T; LANES]; TILE_ROWS]);

/// AMX, with bf16 operands in pairs.
#[derive(Clone, Copy)]
pub(crate) struct Amx(
    /// For everything but products: a processor with AMX for bf16 has AVX512_BF16.
    Bf16,
);

impl Amx {
    /// Returns the AMX instruction set if the processor and the kernel support it for bf16 and a test product
    /// is right. Asks the kernel once for permission to use the tile registers.
    pub(super) fn new() -> Option<Self> {
        static IS_AVAILABLE: OnceLock<bool> = OnceLock::new();
        let vectors = Bf16::new()?;
        let is_available = IS_AVAILABLE
            .get_or_init(|| has_amx_bf16() && request_permission() && passes_self_test(vectors));
        is_available.then_some(Self(vectors))
    }
}

/// Most rows of a tile: four registers of rows.
pub(super) const ROWS_MAX: usize = ACCUMULATORS * TILE_ROWS;

bf16_rounding!(Amx);

impl Simd for Amx {
    type Element = bf16;
    const VECS_MAX: usize = ACCUMULATORS;
    const LEFT_STEPS_ADJACENT: bool = true;
    /// Covers the reduction axis of most products, so that accumulators leave the registers once.
    const STEPS_IN_CACHE: usize = 1024;

    fn rows_max(_: usize) -> usize {
        ROWS_MAX
    }

    unsafe fn compute(self, tile: &RawTile<bf16>, rows: usize, vecs: usize) {
        struct Work<'a>(Bf16, &'a RawTile<bf16>, usize, usize);
        impl Loop for Work<'_> {
            #[inline(always)]
            fn run(self) {
                let Self(simd, tile, rows, vecs) = self;
                // SAFETY: `Amx::new` found the instructions; the caller guarantees the rest.
                unsafe { compute(simd, &mut HardwareTiles, tile, rows, vecs) }
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

/// Computes a tile of products with `tiles`. `simd` transposes blocks.
///
/// # Safety
/// As for `Simd::compute`. The processor has the instructions that `tiles` uses.
#[inline(always)]
pub(super) unsafe fn compute<S: Simd, T: TileRegisters>(
    simd: S,
    tiles: &mut T,
    tile: &RawTile<bf16>,
    rows: usize,
    vecs: usize,
) {
    // SAFETY: guaranteed by the caller.
    unsafe {
        // Adjacent steps fill the rows of a left register directly. If rows are adjacent instead, blocks are transposed first.
        if tile.step_stride == 2 {
            compute_adjacent_steps(tiles, tile, rows, vecs);
        } else {
            compute_adjacent_rows(simd, tiles, tile, rows, vecs);
        }
    }
}

/// Computes the product of rows whose steps are adjacent.
///
/// # Safety
/// As for `compute`, with a step of 2.
#[inline(always)]
unsafe fn compute_adjacent_steps<T: TileRegisters>(
    tiles: &mut T,
    tile: &RawTile<bf16>,
    rows: usize,
    vecs: usize,
) {
    let (whole, tail) = (tile.steps / TILE_STEPS, tile.steps % TILE_STEPS);
    let width = vecs * LANES;
    let mut first = 0;
    while first < rows {
        // Whole registers of rows, or the remaining rows. The accumulators cover a block that is as square as possible.
        let (groups, count) = match (rows - first) / TILE_ROWS {
            0 => (1, rows - first),
            whole => (whole.min(ACCUMULATORS / vecs.min(2)), TILE_ROWS),
        };
        let block_vecs = ACCUMULATORS / groups;
        for first_vec in (0..vecs).step_by(block_vecs) {
            let block_vecs = block_vecs.min(vecs - first_vec);
            // SAFETY: rows, runs and steps are within the tile's, columns within its panel's.
            unsafe {
                tiles.configure(count, tail);
                let sums = Sums {
                    rows: (first, count, groups),
                    vecs: (first_vec, block_vecs),
                };
                sums.load(tiles, tile);
                for run in 0..tile.runs {
                    let left = tile
                        .left
                        .add(first * tile.row_stride + run * tile.run_stride);
                    let panel = tile
                        .panel
                        .add((run * tile.steps * width + first_vec * LANES) * 2);
                    for part in 0..whole + usize::from(tail > 0) {
                        let in_tail = part == whole;
                        let left = left.add(part * TILE_STEPS * 2);
                        let panel = panel.add(part * TILE_STEPS * width * 2);
                        for group in 0..groups {
                            let left = left.add(group * TILE_ROWS * tile.row_stride);
                            tiles.load_left(left, tile.row_stride * 2, in_tail);
                            for at in 0..block_vecs {
                                // Back and forth: a group starts with the right operand with which the previous group ended.
                                let vec = if group % 2 == 0 {
                                    at
                                } else {
                                    block_vecs - 1 - at
                                };
                                if group == 0 || at > 0 {
                                    let panel = panel.add(vec * LANES * 2);
                                    tiles.load_right(panel, width * 4, in_tail);
                                }
                                tiles.dot(group * block_vecs + vec, in_tail);
                            }
                        }
                    }
                }
                sums.store(tiles, tile);
            }
        }
        first += groups * count;
    }
}

/// Computes the product of adjacent rows whose steps are apart. Blocks of 16 steps by 16 rows are transposed,
/// so that steps become adjacent.
///
/// # Safety
/// As for `compute`, with a row stride of 2.
#[inline(always)]
unsafe fn compute_adjacent_rows<S: Simd, T: TileRegisters>(
    simd: S,
    tiles: &mut T,
    tile: &RawTile<bf16>,
    rows: usize,
    vecs: usize,
) {
    assert_eq!(tile.row_stride, 2, "neither steps nor rows are adjacent");
    // The steps of all runs. In the panel they follow each other.
    let steps = tile.runs * tile.steps;
    let (tail, width) = (steps % TILE_STEPS, vecs * LANES);
    for first in (0..rows).step_by(TILE_ROWS) {
        let count = TILE_ROWS.min(rows - first);
        // SAFETY: rows, runs and steps are within the tile's, columns within its panel's.
        unsafe {
            tiles.configure(count, tail);
            let sums = Sums {
                rows: (first, count, 1),
                vecs: (0, vecs),
            };
            sums.load(tiles, tile);
            let (mut run, mut step) = (tile.left.add(first * 2), 0);
            for part in (0..steps).step_by(TILE_STEPS) {
                let in_part = TILE_STEPS.min(steps - part);
                let mut block = AlignedBlock([[0; TILE_ROWS]; TILE_STEPS]);
                for block in &mut block.0[..in_part] {
                    let pairs = run.add(step * tile.step_stride).cast::<u32>();
                    *block = match count {
                        TILE_ROWS => pairs.cast::<[u32; TILE_ROWS]>().read_unaligned(),
                        _ => std::array::from_fn(|row| match row < count {
                            true => pairs.add(row).read_unaligned(),
                            false => 0,
                        }),
                    };
                    step += 1;
                    if step == tile.steps {
                        (run, step) = (run.wrapping_add(tile.run_stride), 0);
                    }
                }
                simd.transpose(&mut block.0);
                let in_tail = in_part < TILE_STEPS;
                tiles.load_left(block.0.as_ptr().cast(), TILE_STEPS * 4, in_tail);
                let panel = tile.panel.add(part * width * 2);
                for vec in 0..vecs {
                    tiles.load_right(panel.add(vec * LANES * 2), width * 4, in_tail);
                    tiles.dot(vec, in_tail);
                }
            }
            sums.store(tiles, tile);
        }
    }
}

/// Accumulator registers, and the rows and columns of the output that they stand for.
struct Sums {
    /// The first row, the rows of a register, and the number of registers along the rows.
    rows: (usize, usize, usize),
    /// The first register of columns, and the number of such registers.
    vecs: (usize, usize),
}

impl Sums {
    /// Iterates over the registers: index, output address, and number of output columns. If that is 0, the address is not used.
    #[inline(always)]
    fn outputs(&self, tile: &RawTile<bf16>) -> impl Iterator<Item = (usize, *mut f32, usize)> {
        let ((first, _, groups), (first_vec, vecs)) = (self.rows, self.vecs);
        let (out, stride, cols) = (tile.out, tile.out_stride, tile.cols);
        (0..groups * vecs).map(move |sums| {
            let row = first + sums / vecs * TILE_ROWS;
            let col = (first_vec + sums % vecs) * LANES;
            let cols = cols.saturating_sub(col).min(LANES);
            (sums, out.wrapping_add(row * stride + col), cols)
        })
    }

    /// Whether the accumulators start from the output's values. Adding afterwards is slower, because it reads memory
    /// that was just stored. If output rows overlap, as in a convolution's gradient, the sums are added afterwards.
    #[inline(always)]
    fn starts_from_output(tile: &RawTile<bf16>) -> bool {
        tile.mode == Mode::Add && tile.out_stride >= tile.cols
    }

    /// # Safety
    /// The output has these rows and columns, up to `tile.cols`.
    #[inline(always)]
    unsafe fn load<T: TileRegisters>(&self, tiles: &mut T, tile: &RawTile<bf16>) {
        if !Self::starts_from_output(tile) {
            return;
        }
        for (sums, out, cols) in self.outputs(tile) {
            if cols == LANES {
                // SAFETY: guaranteed by the caller.
                unsafe { tiles.load_sums(sums, out, tile.out_stride * 4) }
            } else if cols > 0 {
                let mut block = AlignedBlock([[0.0; LANES]; TILE_ROWS]);
                for (row, to) in block.0.iter_mut().enumerate().take(self.rows.1) {
                    // SAFETY: guaranteed by the caller.
                    let from = unsafe { from_raw_parts(out.add(row * tile.out_stride), cols) };
                    to[..cols].copy_from_slice(from);
                }
                // SAFETY: a block has room for a register.
                unsafe { tiles.load_sums(sums, block.0.as_ptr().cast(), LANES * 4) }
            }
        }
    }

    /// Writes the accumulators, or adds them if the mode is `Add` and they did not start from the output.
    ///
    /// # Safety
    /// As for `load`.
    #[inline(always)]
    unsafe fn store<T: TileRegisters>(&self, tiles: &mut T, tile: &RawTile<bf16>) {
        let replaces = tile.mode == Mode::Replace || Self::starts_from_output(tile);
        // All registers are stored first, because memory that was just stored is slow to read.
        let mut blocks = [const { MaybeUninit::<AlignedBlock<f32>>::uninit() }; ACCUMULATORS];
        for ((sums, out, cols), block) in self.outputs(tile).zip(&mut blocks) {
            // SAFETY: guaranteed by the caller; a block has room for a register.
            unsafe {
                match replaces && cols == LANES {
                    true => tiles.store(sums, out, tile.out_stride * 4),
                    false => tiles.store(sums, block.as_mut_ptr().cast(), LANES * 4),
                }
            }
        }
        for ((_, out, cols), block) in self.outputs(tile).zip(&blocks) {
            if cols == 0 || (replaces && cols == LANES) {
                continue;
            }
            for row in 0..self.rows.1 {
                // SAFETY: `self.rows.1` rows were stored; the tile borrows the output exclusively.
                unsafe {
                    let sums = &*block.as_ptr().cast::<[f32; LANES]>().add(row);
                    let out = from_raw_parts_mut(out.add(row * tile.out_stride), cols);
                    if replaces {
                        out.copy_from_slice(&sums[..cols]);
                    } else if let Ok(out) = <&mut [f32; LANES]>::try_from(&mut *out) {
                        // A known length compiles to one instruction.
                        add(out, sums);
                    } else {
                        add(out, sums);
                    }
                }
            }
        }
    }
}

#[inline(always)]
fn add(out: &mut [f32], sums: &[f32; LANES]) {
    for (out, sum) in out.iter_mut().zip(sums) {
        *out += sum;
    }
}
