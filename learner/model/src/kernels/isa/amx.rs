//! AMX: products of whole tiles of bf16, up to 16 rows by 16 columns by 32 terms an instruction.
//! The arithmetic of the tiles is a trait, so that what cuts products into tiles is tested on processors without them.
#![allow(unsafe_code, reason = "instructions of one kind of processor")]
#![cfg(target_arch = "x86_64")]

use std::{
    mem::MaybeUninit,
    slice::{from_raw_parts, from_raw_parts_mut},
    sync::OnceLock,
};

use half::bf16;

use super::amx_permission::{granted, has_amx_bf16};
use super::amx_tiles::{Hardware, ROWS, STEPS, SUMS, Tiles};
use super::avx512::{Bf16, bf16_rounding};
use super::avx512_rounding;
use super::element::Rounding;
use super::simd::{LANES, Loop, Mode, RawTile, Simd};

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

/// A row for each row of a register, none of which crosses the lines of a cache.
#[repr(align(64))]
struct Block<T>([[T; LANES]; ROWS]);

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
    /// The sum of most products, so that it leaves the registers once.
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

/// The product of rows whose steps lie side by side.
///
/// # Safety
/// As for `compute`, with a step of 2.
#[inline(always)]
unsafe fn by_rows<T: Tiles>(tiles: &mut T, tile: &RawTile<bf16>, rows: usize, vecs: usize) {
    let (whole, tail) = (tile.steps / STEPS, tile.steps % STEPS);
    let width = vecs * LANES;
    let mut first = 0;
    while first < rows {
        // Whole registers of rows, or what is left; as square a block of them as there are sums for.
        let (groups, count) = match (rows - first) / ROWS {
            0 => (1, rows - first),
            whole => (whole.min(SUMS / vecs.min(2)), ROWS),
        };
        let block_vecs = SUMS / groups;
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
                        let left = left.add(part * STEPS * 2);
                        let panel = panel.add(part * STEPS * width * 2);
                        for group in 0..groups {
                            let left = left.add(group * ROWS * tile.row_stride);
                            tiles.load_left(left, tile.row_stride * 2, in_tail);
                            for at in 0..block_vecs {
                                // Back and forth: a group begins with the right operand that the one before has ended with.
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

/// The product of rows whose steps are apart, and which lie side by side themselves: blocks of 16 of both are turned, so that steps
/// lie side by side.
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
    // Of all runs, whose steps follow each other in the panel.
    let steps = tile.runs * tile.steps;
    let (tail, width) = (steps % STEPS, vecs * LANES);
    for first in (0..rows).step_by(ROWS) {
        let count = ROWS.min(rows - first);
        // SAFETY: rows, runs and steps are within the tile's, columns within its panel's.
        unsafe {
            tiles.configure(count, tail);
            let sums = Sums {
                rows: (first, count, 1),
                vecs: (0, vecs),
            };
            sums.load(tiles, tile);
            let (mut run, mut step) = (tile.left.add(first * 2), 0);
            for part in (0..steps).step_by(STEPS) {
                let in_part = STEPS.min(steps - part);
                let mut block = Block([[0; ROWS]; STEPS]);
                for block in &mut block.0[..in_part] {
                    let pairs = run.add(step * tile.step).cast::<u32>();
                    *block = match count {
                        ROWS => pairs.cast::<[u32; ROWS]>().read_unaligned(),
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
                let in_tail = in_part < STEPS;
                tiles.load_left(block.0.as_ptr().cast(), STEPS * 4, in_tail);
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

/// Registers of sums, and the rows and columns of the output that they are for.
struct Sums {
    /// The first row, rows of a register, and registers of rows.
    rows: (usize, usize, usize),
    /// The first register of columns, and how many there are.
    vecs: (usize, usize),
}

impl Sums {
    /// Each register's number, where its sums go, and how many columns it has there; without columns the place is not used.
    #[inline(always)]
    fn places(&self, tile: &RawTile<bf16>) -> impl Iterator<Item = (usize, *mut f32, usize)> {
        let ((first, _, groups), (first_vec, vecs)) = (self.rows, self.vecs);
        let (out, stride, cols) = (tile.out, tile.out_stride, tile.cols);
        (0..groups * vecs).map(move |sums| {
            let row = first + sums / vecs * ROWS;
            let col = (first_vec + sums % vecs) * LANES;
            let cols = cols.saturating_sub(col).min(LANES);
            (sums, out.wrapping_add(row * stride + col), cols)
        })
    }

    /// Whether sums begin with what is in the output. To be added afterwards they leave the registers, and what was just stored is
    /// slow to read; where rows of the output overlap, as those of a convolution's gradient do, they are.
    #[inline(always)]
    fn begin_with_output(tile: &RawTile<bf16>) -> bool {
        tile.mode == Mode::Add && tile.out_stride >= tile.cols
    }

    /// # Safety
    /// The output has them, as far as `tile.cols` goes.
    #[inline(always)]
    unsafe fn load<T: Tiles>(&self, tiles: &mut T, tile: &RawTile<bf16>) {
        if !Self::begin_with_output(tile) {
            return;
        }
        for (sums, out, cols) in self.places(tile) {
            if cols == LANES {
                // SAFETY: the caller's.
                unsafe { tiles.load_sums(sums, out, tile.out_stride * 4) }
            } else if cols > 0 {
                let mut block = Block([[0.0; LANES]; ROWS]);
                for (row, to) in block.0.iter_mut().enumerate().take(self.rows.1) {
                    // SAFETY: the caller's.
                    let from = unsafe { from_raw_parts(out.add(row * tile.out_stride), cols) };
                    to[..cols].copy_from_slice(from);
                }
                // SAFETY: a block has room for a register.
                unsafe { tiles.load_sums(sums, block.0.as_ptr().cast(), LANES * 4) }
            }
        }
    }

    /// Writes them, or adds them if they were to be added and did not begin with the output.
    ///
    /// # Safety
    /// As for `load`.
    #[inline(always)]
    unsafe fn store<T: Tiles>(&self, tiles: &mut T, tile: &RawTile<bf16>) {
        let replaces = tile.mode == Mode::Replace || Self::begin_with_output(tile);
        // All of them first: what was just stored is slow to read.
        let mut blocks = [const { MaybeUninit::<Block<f32>>::uninit() }; SUMS];
        for ((sums, out, cols), block) in self.places(tile).zip(&mut blocks) {
            // SAFETY: the caller's; a block has room for a register.
            unsafe {
                match replaces && cols == LANES {
                    true => tiles.store(sums, out, tile.out_stride * 4),
                    false => tiles.store(sums, block.as_mut_ptr().cast(), LANES * 4),
                }
            }
        }
        for ((_, out, cols), block) in self.places(tile).zip(&blocks) {
            if cols == 0 || (replaces && cols == LANES) {
                continue;
            }
            for row in 0..self.rows.1 {
                // SAFETY: so many rows were stored; the output is exclusively borrowed by the tile.
                unsafe {
                    let sums = &*block.as_ptr().cast::<[f32; LANES]>().add(row);
                    let out = from_raw_parts_mut(out.add(row * tile.out_stride), cols);
                    if replaces {
                        out.copy_from_slice(&sums[..cols]);
                    } else if let Ok(out) = <&mut [f32; LANES]>::try_from(&mut *out) {
                        // A length that is known is one instruction.
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
