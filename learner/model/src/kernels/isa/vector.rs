//! The loop that all instruction sets with vector registers share: a tile's accumulators stay in registers over all steps.
//! It names no instructions: each instruction set supplies its own.

use super::{
    element::Element,
    simd::{LANES, Mode, RawTile},
};

/// Neighbouring pixels of a window's row in [`add_windows`].
const TAPS: usize = 3;

/// Accumulators of `LANES` columns, in registers.
#[allow(unsafe_code, reason = "instructions of one kind of processor")]
pub(super) trait Sums: Copy {
    unsafe fn zero() -> Self;
    /// Writes the first `count` sums, after adding the old values if `add`. If `count` is 0, `at` is not accessed.
    unsafe fn write(self, at: *mut f32, count: usize, add: bool);
}

/// The vector instructions in which the shared loop is written.
#[allow(unsafe_code, reason = "instructions of one kind of processor")]
pub(super) trait Vector: Copy {
    type Element: Element;
    type Sums: Sums;
    /// One step of `LANES` columns, or of one row.
    type Operand: Copy;
    /// Registers that hold one of `Sums` or an operand; 0 if there are too few for [`add_windows`].
    const REGISTERS: usize = 0;

    /// Loads the step at `at` of one row and broadcasts it to all columns.
    unsafe fn load_row(at: *const Self::Element) -> Self::Operand;
    /// Loads the steps of `LANES` neighbouring columns.
    unsafe fn load_columns(at: *const Self::Element) -> Self::Operand;
    unsafe fn mul_add(sums: Self::Sums, row: Self::Operand, columns: Self::Operand) -> Self::Sums;
}

/// The loop of every instruction set with vector registers. The caller compiles it for its instructions.
///
/// # Safety
/// The processor has the instructions of `V`. Otherwise as for `Simd::compute`.
#[inline(always)]
#[allow(unsafe_code, reason = "instructions and pointers")]
pub(super) unsafe fn compute<V: Vector, const ROWS: usize, const VECS: usize>(
    tile: &RawTile<V::Element>,
) {
    // SAFETY: `RawTile` allows every address that is used; the caller guarantees the instructions.
    unsafe {
        let mut sums = [[V::Sums::zero(); VECS]; ROWS];
        let fits = ROWS * VECS + TAPS * VECS + TAPS <= V::REGISTERS;
        if fits && tile.has_three_taps() {
            add_windows::<V, ROWS, VECS>(tile, &mut sums);
        } else {
            add_products::<V, ROWS, VECS>(tile, &mut sums);
        }
        // By value: references would keep the accumulators in memory in the loops above.
        for (r, sums) in sums.into_iter().enumerate() {
            let out = tile.out.add(r * tile.out_stride);
            for (v, sums) in sums.into_iter().enumerate() {
                let count = tile.cols.saturating_sub(v * LANES).min(LANES);
                sums.write(out.wrapping_add(v * LANES), count, tile.mode == Mode::Add);
            }
        }
    }
}

/// Adds the products of a tile to `sums`, step after step.
#[inline(always)]
#[allow(unsafe_code, reason = "instructions and pointers")]
unsafe fn add_products<V: Vector, const ROWS: usize, const VECS: usize>(
    tile: &RawTile<V::Element>,
    sums: &mut [[V::Sums; VECS]; ROWS],
) {
    // SAFETY: as for `compute`.
    unsafe {
        let (mut panel, mut run) = (tile.panel, tile.left);
        for _ in 0..tile.runs {
            let mut at = run;
            for _ in 0..tile.steps {
                let columns = load_columns::<V, VECS>(panel);
                for (r, sums) in sums.iter_mut().enumerate() {
                    let row = V::load_row(at.add(r * tile.row_stride));
                    for (sums, columns) in sums.iter_mut().zip(columns) {
                        *sums = V::mul_add(*sums, row, columns);
                    }
                }
                panel = panel.add(VECS * LANES * V::Element::DEPTH);
                // The last step of the last run may end at the end of the allocation.
                at = at.wrapping_add(tile.step_stride);
            }
            run = run.wrapping_add(tile.run_stride);
        }
    }
}

/// [`add_products`] of windows with [`RawTile::has_three_taps`]: a pixel is loaded once for the three windows it lies in.
///
/// [`add_products`] loads an operand for each product of a tile one register wide. Processors that load as seldom as they multiply
/// then reach half of their peak.
#[inline(always)]
#[allow(unsafe_code, reason = "instructions and pointers")]
unsafe fn add_windows<V: Vector, const ROWS: usize, const VECS: usize>(
    tile: &RawTile<V::Element>,
    sums: &mut [[V::Sums; VECS]; ROWS],
) {
    // SAFETY: as for `compute`; row r reads at tap t what row r + t reads at tap 0.
    unsafe {
        let step_len = VECS * LANES * V::Element::DEPTH;
        let tap_steps = tile.steps / TAPS;
        for run in 0..tile.runs {
            let pixels = tile.left.wrapping_add(run * tile.run_stride);
            let panel = tile.panel.add(run * tile.steps * step_len);
            for step in 0..tap_steps {
                let first = panel.add(step * step_len);
                let mut columns = [load_columns::<V, VECS>(first); TAPS];
                for (tap, columns) in columns.iter_mut().enumerate().skip(1) {
                    *columns = load_columns::<V, VECS>(first.add(tap * tap_steps * step_len));
                }
                let at = pixels.wrapping_add(step * tile.step_stride);
                let mut window = [V::load_row(at); TAPS];
                window[1] = V::load_row(at.add(tile.row_stride));
                for (r, sums) in sums.iter_mut().enumerate() {
                    window[2] = V::load_row(at.add((r + 2) * tile.row_stride));
                    for (pixel, columns) in window.into_iter().zip(columns) {
                        for (sums, columns) in sums.iter_mut().zip(columns) {
                            *sums = V::mul_add(*sums, pixel, columns);
                        }
                    }
                    window = [window[1], window[2], window[2]];
                }
            }
        }
    }
}

/// Loads one step of a panel.
#[inline(always)]
#[allow(unsafe_code, reason = "instructions and pointers")]
unsafe fn load_columns<V: Vector, const VECS: usize>(
    panel: *const V::Element,
) -> [V::Operand; VECS] {
    // SAFETY: as for `compute`. No closure: it could be compiled without these instructions, and each would then be a call.
    unsafe {
        let mut columns = [V::load_columns(panel); VECS];
        for (v, columns) in columns.iter_mut().enumerate().skip(1) {
            *columns = V::load_columns(panel.add(v * LANES * V::Element::DEPTH));
        }
        columns
    }
}

/// Calls [`compute`] with the sizes as constants. The arms must cover every size that the instruction set allows.
macro_rules! compute_sizes {
    ($vector:ty, $tile:expr, $rows:expr, $vecs:expr; $($v:literal: $($r:literal)*;)*) => {
        match ($vecs, $rows) {
            $($(($v, $r) => unsafe { $crate::kernels::isa::vector::compute::<$vector, $r, $v>($tile) },)*)*
            (vecs, rows) => unreachable!("a tile of {rows} rows by {vecs} registers"),
        }
    };
}
pub(super) use compute_sizes;
