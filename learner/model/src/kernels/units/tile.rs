//! One tile of a matrix product: what it reads and writes, checked once, and the loop that all vector units share.
//! It does not cut matrices into tiles.

use super::{Element, LANES, Unit};

/// The left operand of a tile: rows at a fixed distance, whose scalars along the sum lie in runs of steps.
///
/// A step is [`Element::DEPTH`] neighbours. The rows of a matrix are one run each; the windows of an image are a run for each
/// row of the kernel, so that they need not be copied out.
#[derive(Clone, Copy)]
pub(crate) struct Left<'a, E> {
    pub(crate) values: &'a [E],
    /// Index of the first row's first scalar.
    pub(crate) start: usize,
    /// Scalars from one row to the next.
    pub(crate) row_stride: usize,
    /// Scalars from one step to the next.
    pub(crate) step: usize,
    /// Steps in a run.
    pub(crate) steps: usize,
    /// Scalars from one run to the next.
    pub(crate) run_stride: usize,
    /// Runs.
    pub(crate) runs: usize,
}

impl<E: Element> Left<'_, E> {
    /// Whether so many rows lie inside the values.
    fn holds(&self, rows: usize) -> bool {
        let last = self.start
            + (rows - 1) * self.row_stride
            + (self.runs - 1) * self.run_stride
            + (self.steps - 1) * self.step;
        last + E::DEPTH <= self.values.len()
    }
}

/// What a product does to the output's old content.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Mode {
    /// out = a b
    Replace,
    /// out = out + a b, row after row, so that rows of the output may overlap.
    Add,
}

/// Where a tile's result goes.
pub(crate) struct Columns<'a> {
    /// From the first row's first column on.
    pub(crate) out: &'a mut [f32],
    /// Scalars from one row to the next.
    pub(crate) stride: usize,
    /// Columns that are written; at most `vecs` registers of them.
    pub(crate) cols: usize,
    /// Registers of columns that are computed.
    pub(crate) vecs: usize,
    pub(crate) mode: Mode,
}

/// A tile as the units take it.
///
/// `left` may be read at row * row_stride + run * run_stride + step * step_len for every row, run and step, `DEPTH` scalars each;
/// `panel` holds runs * steps * vecs * LANES * DEPTH scalars; `out` may be read and written at row * out_stride, `cols` scalars each.
pub(crate) struct RawTile<E> {
    pub(super) left: *const E,
    pub(super) row_stride: usize,
    pub(super) step: usize,
    pub(super) steps: usize,
    pub(super) run_stride: usize,
    pub(super) runs: usize,
    pub(super) panel: *const E,
    pub(super) out: *mut f32,
    pub(super) out_stride: usize,
    pub(super) cols: usize,
    pub(super) mode: Mode,
}

/// Multiplies `rows` rows of `left` by `panel` [runs * steps, vecs * LANES, DEPTH].
///
/// Each sum is taken in the order of the runs and steps, on every unit.
///
/// # Panics
/// If a size is 0 or beyond the unit's, or an operand or the output is too short.
pub(crate) fn multiply_tile<U: Unit>(
    unit: U,
    rows: usize,
    left: Left<'_, U::Element>,
    panel: &[U::Element],
    columns: Columns<'_>,
) {
    let Columns {
        out,
        stride,
        cols,
        vecs,
        mode,
    } = columns;
    assert!(
        (1..=U::VECS_MAX).contains(&vecs) && (1..=U::rows_max(vecs)).contains(&rows),
        "a tile of {rows} rows by {vecs} registers"
    );
    assert!(
        (1..=vecs * LANES).contains(&cols) && left.steps > 0 && left.runs > 0,
        "{cols} columns, {} steps, {} runs",
        left.steps,
        left.runs
    );
    let panel_len = left.runs * left.steps * vecs * LANES * U::Element::DEPTH;
    assert!(
        left.holds(rows) && panel.len() >= panel_len && (rows - 1) * stride + cols <= out.len(),
        "a tile beyond its operands"
    );
    let tile = RawTile {
        left: left.values[left.start..].as_ptr(),
        row_stride: left.row_stride,
        step: left.step,
        steps: left.steps,
        run_stride: left.run_stride,
        runs: left.runs,
        panel: panel.as_ptr(),
        out: out.as_mut_ptr(),
        out_stride: stride,
        cols,
        mode,
    };
    // SAFETY: the sizes are the unit's, and the asserts above are what `RawTile` asks for: the largest index of each operand
    // is inside its slice, and all others are smaller, as strides are not negative. `out` is exclusively borrowed.
    #[allow(unsafe_code, reason = "units work on pointers")]
    unsafe {
        unit.compute(&tile, rows, vecs);
    }
}

/// Registers of columns in each panel of a right operand with this many columns.
pub(crate) fn tile_vecs<U: Unit>(cols: usize) -> usize {
    match cols.div_ceil(LANES) {
        0 | 1 => 1,
        2 => 2.min(U::VECS_MAX),
        _ => U::VECS_MAX,
    }
}

/// Cuts `rows` into as few tiles as go, of about equal size: (first, rows) of each.
pub(crate) fn row_tiles<U: Unit>(
    rows: usize,
    vecs: usize,
) -> impl Iterator<Item = (usize, usize)> + Clone {
    let tiles = rows.div_ceil(U::rows_max(vecs)).max(1);
    (0..tiles).filter_map(move |tile| {
        let (first, end) = (rows * tile / tiles, rows * (tile + 1) / tiles);
        (end > first).then(|| (first, end - first))
    })
}

/// The vector instructions that the shared loop is written in.
#[allow(unsafe_code, reason = "instructions of one kind of processor")]
pub(super) trait Vector: Copy {
    type Element: Element;
    /// Sums of `LANES` columns.
    type Sums: Copy;
    /// One step of `LANES` columns, or of one row.
    type Operand: Copy;

    unsafe fn zero() -> Self::Sums;
    /// The step at this place, for all columns.
    unsafe fn row(at: *const Self::Element) -> Self::Operand;
    /// The steps of `LANES` neighbouring columns.
    unsafe fn columns(at: *const Self::Element) -> Self::Operand;
    unsafe fn mul_add(sums: Self::Sums, row: Self::Operand, columns: Self::Operand) -> Self::Sums;
    /// Writes the first `count` sums, after adding what is there if `add`. `count` may be 0; `at` is then not looked at.
    unsafe fn write(sums: Self::Sums, at: *mut f32, count: usize, add: bool);
}

/// The loop of every vector unit, to be compiled for its instructions.
///
/// # Safety
/// The processor has the instructions of `V`; otherwise as `Unit::compute`.
#[inline(always)]
#[allow(unsafe_code, reason = "instructions and pointers")]
pub(super) unsafe fn compute<V: Vector, const ROWS: usize, const VECS: usize>(
    tile: &RawTile<V::Element>,
) {
    // SAFETY: every address is one that `RawTile` says may be used; the caller answers for the instructions.
    unsafe {
        let mut sums = [[V::zero(); VECS]; ROWS];
        let (mut panel, mut run) = (tile.panel, tile.left);
        for _ in 0..tile.runs {
            let mut at = run;
            for _ in 0..tile.steps {
                let columns: [V::Operand; VECS] =
                    std::array::from_fn(|v| V::columns(panel.add(v * LANES * V::Element::DEPTH)));
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
        for (r, sums) in sums.iter().enumerate() {
            let out = tile.out.add(r * tile.out_stride);
            for (v, &sums) in sums.iter().enumerate() {
                let count = tile.cols.saturating_sub(v * LANES).min(LANES);
                V::write(
                    sums,
                    out.wrapping_add(v * LANES),
                    count,
                    tile.mode == Mode::Add,
                );
            }
        }
    }
}

/// Calls [`compute`] with the sizes as constants; the arms must be all that a unit allows.
macro_rules! compute_sizes {
    ($vector:ty, $tile:expr, $rows:expr, $vecs:expr; $($v:literal: $($r:literal)*;)*) => {
        match ($vecs, $rows) {
            $($(($v, $r) => unsafe { $crate::kernels::units::tile::compute::<$vector, $r, $v>($tile) },)*)*
            (vecs, rows) => unreachable!("a tile of {rows} rows by {vecs} registers"),
        }
    };
}
pub(super) use compute_sizes;
