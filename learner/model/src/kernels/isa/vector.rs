//! The loop that all instruction sets with vector registers share: a tile's sums stay in registers while steps pass.
//! It names no instruction: each instruction set brings its own.

use super::{
    element::Element,
    simd::{LANES, Mode, RawTile},
};

/// Sums of `LANES` columns, in registers.
#[allow(unsafe_code, reason = "instructions of one kind of processor")]
pub(super) trait Sums: Copy {
    unsafe fn zero() -> Self;
    /// Writes the first `count` sums, after adding what is there if `add`. `count` may be 0; `at` is then not looked at.
    unsafe fn write(self, at: *mut f32, count: usize, add: bool);
}

/// The vector instructions that the shared loop is written in.
#[allow(unsafe_code, reason = "instructions of one kind of processor")]
pub(super) trait Vector: Copy {
    type Element: Element;
    type Sums: Sums;
    /// One step of `LANES` columns, or of one row.
    type Operand: Copy;

    /// The step at this place, for all columns.
    unsafe fn row(at: *const Self::Element) -> Self::Operand;
    /// The steps of `LANES` neighbouring columns.
    unsafe fn columns(at: *const Self::Element) -> Self::Operand;
    unsafe fn mul_add(sums: Self::Sums, row: Self::Operand, columns: Self::Operand) -> Self::Sums;
}

/// The loop of every instruction set with vectors, to be compiled for it.
///
/// # Safety
/// The processor has the instructions of `V`; otherwise as `Simd::compute`.
#[inline(always)]
#[allow(unsafe_code, reason = "instructions and pointers")]
pub(super) unsafe fn compute<V: Vector, const ROWS: usize, const VECS: usize>(
    tile: &RawTile<V::Element>,
) {
    // SAFETY: every address is one that `RawTile` says may be used; the caller answers for the instructions.
    unsafe {
        let mut sums = [[V::Sums::zero(); VECS]; ROWS];
        let (mut panel, mut run) = (tile.panel, tile.left);
        for _ in 0..tile.runs {
            let mut at = run;
            for _ in 0..tile.steps {
                // No closure here: it may be compiled without these instructions, and each is then a call.
                let mut columns = [V::columns(panel); VECS];
                for (v, columns) in columns.iter_mut().enumerate().skip(1) {
                    *columns = V::columns(panel.add(v * LANES * V::Element::DEPTH));
                }
                for (r, sums) in sums.iter_mut().enumerate() {
                    let row = V::row(at.add(r * tile.row_stride));
                    for (sums, columns) in sums.iter_mut().zip(columns) {
                        *sums = V::mul_add(*sums, row, columns);
                    }
                }
                panel = panel.add(VECS * LANES * V::Element::DEPTH);
                // The last step of the last run may end at the end of the allocation.
                at = at.wrapping_add(tile.step);
            }
            run = run.wrapping_add(tile.run_stride);
        }
        // By value: references to the sums would keep them in memory in the loops above.
        for (r, sums) in sums.into_iter().enumerate() {
            let out = tile.out.add(r * tile.out_stride);
            for (v, sums) in sums.into_iter().enumerate() {
                let count = tile.cols.saturating_sub(v * LANES).min(LANES);
                sums.write(out.wrapping_add(v * LANES), count, tile.mode == Mode::Add);
            }
        }
    }
}

/// Calls [`compute`] with the sizes as constants; the arms must be all that an instruction set allows.
macro_rules! compute_sizes {
    ($vector:ty, $tile:expr, $rows:expr, $vecs:expr; $($v:literal: $($r:literal)*;)*) => {
        match ($vecs, $rows) {
            $($(($v, $r) => unsafe { $crate::kernels::isa::vector::compute::<$vector, $r, $v>($tile) },)*)*
            (vecs, rows) => unreachable!("a tile of {rows} rows by {vecs} registers"),
        }
    };
}
pub(super) use compute_sizes;
