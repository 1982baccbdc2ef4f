//! The loop that all instruction sets with vector registers share: a tile's accumulators stay in registers over all steps.
//! It names no instructions: each instruction set supplies its own.

use super::{
    element::Element,
    simd::{LANES, Mode, RawTile},
};

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
    /// Registers that hold one of `Sums` or an operand; 0 if there are too few for windows.
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
        let fits = |taps| ROWS * VECS + taps * VECS + taps <= V::REGISTERS;
        match tile.taps() {
            2 if fits(2) => add_products::<V, ROWS, VECS, 2>(tile, &mut sums),
            3 if fits(3) => add_products::<V, ROWS, VECS, 3>(tile, &mut sums),
            _ => add_products::<V, ROWS, VECS, 1>(tile, &mut sums),
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

/// Adds the products of a tile to `sums`. With more than one of `TAPS`, which are then [`RawTile::taps`], a pixel is loaded once for all
/// windows it lies in.
/// With one tap, a tile one register wide loads an operand for each product. A processor that loads as seldom as it multiplies then
/// reaches half of its peak.
#[inline(always)]
#[allow(unsafe_code, reason = "instructions and pointers")]
unsafe fn add_products<V: Vector, const ROWS: usize, const VECS: usize, const TAPS: usize>(
    tile: &RawTile<V::Element>,
    sums: &mut [[V::Sums; VECS]; ROWS],
) {
    // SAFETY: as for `compute`; row r reads at tap t what row r + t reads at tap 0.
    unsafe {
        let (len, tap_steps) = (LANES * V::Element::DEPTH, tile.steps / TAPS);
        let (mut panel, mut run) = (tile.panel, tile.left);
        for _ in 0..tile.runs {
            let mut at = run;
            for _ in 0..tap_steps {
                // No closure here: it could be compiled without these instructions, and each would then be a call.
                let mut columns = [[V::load_columns(panel); VECS]; TAPS];
                for (tap, columns) in columns.iter_mut().enumerate() {
                    for (v, columns) in columns.iter_mut().enumerate() {
                        *columns = V::load_columns(panel.add((tap * tap_steps * VECS + v) * len));
                    }
                }
                // The last `TAPS` are the pixels of a row. A shorter array, or one that is rotated, would stay in memory.
                let mut window = [V::load_row(at); 3];
                if TAPS == 3 {
                    window[1] = V::load_row(at.add(tile.row_stride));
                }
                for (r, sums) in sums.iter_mut().enumerate() {
                    window[2] = V::load_row(at.add((r + TAPS - 1) * tile.row_stride));
                    for (tap, columns) in columns.into_iter().enumerate() {
                        for (sums, columns) in sums.iter_mut().zip(columns) {
                            *sums = V::mul_add(*sums, window[3 - TAPS + tap], columns);
                        }
                    }
                    window = [window[1], window[2], window[2]];
                }
                panel = panel.add(VECS * len);
                // The last step of the last run may end at the end of the allocation.
                at = at.wrapping_add(tile.step_stride);
            }
            panel = panel.add((TAPS - 1) * tap_steps * VECS * len);
            run = run.wrapping_add(tile.run_stride);
        }
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
