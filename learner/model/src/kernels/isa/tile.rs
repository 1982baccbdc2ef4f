//! One tile of a matrix product: its operands and output are checked before an instruction set computes it.
//! This module does not cut matrices into tiles.

use super::{
    element::Element,
    simd::{LANES, Mode, RawTile, Simd},
};

/// The left operand of a tile: rows at a fixed distance. Along the reduction axis, each row consists of runs of steps.
///
/// A step is [`Element::DEPTH`] neighbouring scalars. A matrix row is one run. An image window has one run
/// for each row of the kernel, so that windows need not be copied.
#[derive(Clone, Copy)]
pub(crate) struct LeftOperand<'a, E> {
    pub(crate) values: &'a [E],
    /// Index of the first row's first scalar.
    pub(crate) start: usize,
    /// Scalars from one row to the next.
    pub(crate) row_stride: usize,
    /// Scalars from one step to the next.
    pub(crate) step_stride: usize,
    pub(crate) steps: usize,
    /// Scalars from one run to the next.
    pub(crate) run_stride: usize,
    pub(crate) runs: usize,
}

impl<'a, E: Element> LeftOperand<'a, E> {
    /// Rows of a matrix, `row_stride` scalars apart, which must be whole steps.
    pub(crate) const fn rows(values: &'a [E], row_stride: usize) -> Self {
        Self {
            values,
            start: 0,
            row_stride,
            step_stride: E::DEPTH,
            steps: row_stride / E::DEPTH,
            run_stride: 0,
            runs: 1,
        }
    }

    /// Whether `rows` rows lie inside the values.
    fn contains_rows(&self, rows: usize) -> bool {
        let last = self.start
            + (rows - 1) * self.row_stride
            + (self.runs - 1) * self.run_stride
            + (self.steps - 1) * self.step_stride;
        last + E::DEPTH <= self.values.len()
    }
}

pub(crate) struct OutputTile<'a> {
    /// The output, from the first row's first column on.
    pub(crate) out: &'a mut [f32],
    /// Scalars from one row to the next.
    pub(crate) row_stride: usize,
    /// Columns that are written, at most `vecs` registers.
    pub(crate) cols: usize,
    /// Registers of columns that are computed.
    pub(crate) vecs: usize,
    pub(crate) mode: Mode,
}

/// Multiplies `rows` rows of `left` by `panel` [runs * steps, vecs * LANES, DEPTH].
///
/// Sums are in the order of the runs and steps; AVX-512 takes those that share a pixel together.
///
/// # Panics
/// If a size is 0 or beyond the instruction set's, or an operand or the output is too short.
pub(crate) fn multiply_tile<S: Simd>(
    simd: S,
    rows: usize,
    left: LeftOperand<'_, S::Element>,
    panel: &[S::Element],
    output: OutputTile<'_>,
) {
    let (vecs, cols) = (output.vecs, output.cols);
    assert!(
        (1..=S::VECS_MAX).contains(&vecs) && (1..=S::rows_max(vecs)).contains(&rows),
        "a tile of {rows} rows by {vecs} registers"
    );
    assert!(
        (1..=vecs * LANES).contains(&cols) && left.steps > 0 && left.runs > 0,
        "{cols} columns, {} steps, {} runs",
        left.steps,
        left.runs
    );
    let panel_len = left.runs * left.steps * vecs * LANES * S::Element::DEPTH;
    assert!(
        left.contains_rows(rows)
            && panel.len() >= panel_len
            && (rows - 1) * output.row_stride + cols <= output.out.len(),
        "a tile beyond its operands"
    );
    let tile = RawTile {
        left: left.values[left.start..].as_ptr(),
        row_stride: left.row_stride,
        step_stride: left.step_stride,
        steps: left.steps,
        run_stride: left.run_stride,
        runs: left.runs,
        panel: panel.as_ptr(),
        out: output.out.as_mut_ptr(),
        out_stride: output.row_stride,
        cols,
        mode: output.mode,
    };
    // SAFETY: the sizes are within the instruction set's limits, and the asserts above check what `RawTile` requires. The
    // largest index of each operand is inside its slice, and strides are not negative. `out` is borrowed exclusively.
    #[allow(unsafe_code, reason = "tiles are read and written through pointers")]
    unsafe {
        simd.compute(&tile, rows, vecs);
    }
}

/// Returns the width, in registers, of each panel of a right operand with this many columns.
pub(crate) fn tile_vecs<S: Simd>(cols: usize) -> usize {
    match cols.div_ceil(LANES) {
        0 | 1 => 1,
        2 => 2.min(S::VECS_MAX),
        _ => S::VECS_MAX,
    }
}

/// Cuts `rows` into as few tiles as possible, of about equal height, and yields (first, rows) of each.
pub(crate) fn row_tiles<S: Simd>(
    rows: usize,
    vecs: usize,
) -> impl Iterator<Item = (usize, usize)> + Clone {
    let tiles = rows.div_ceil(S::rows_max(vecs)).max(1);
    (0..tiles).filter_map(move |tile| {
        let (first, end) = (rows * tile / tiles, rows * (tile + 1) / tiles);
        (end > first).then(|| (first, end - first))
    })
}
