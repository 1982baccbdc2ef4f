//! Operands of products, rounded and laid out as tiles read them: right operands in panels, left operands in rows.
//! This module splits no output.

use rayon::prelude::*;

use crate::kernels::buffer::{ALIGNMENT, Buffer, Scalars};
use crate::kernels::isa::{
    Element, LANES, LeftOperand, Mode, OutputTile, Simd, multiply_tile, row_tiles, tile_vecs,
    vectorized,
};
use crate::kernels::rounding::write_rows;

/// A matrix view of a slice. Contiguous runs of the slice are its rows, or its columns if it is transposed.
#[derive(Clone, Copy)]
pub(crate) struct Matrix<'a> {
    data: &'a [f32],
    pub(crate) rows: usize,
    pub(crate) cols: usize,
    /// Scalars from the start of one run to the start of the next.
    stride: usize,
    transposed: bool,
}

impl<'a> Matrix<'a> {
    /// Creates a matrix of `data` [rows, cols], row after row.
    pub(crate) fn new(data: &'a [f32], rows: usize, cols: usize) -> Self {
        assert_eq!(data.len(), rows * cols, "a {rows}x{cols} matrix");
        Self {
            data,
            rows,
            cols,
            stride: cols,
            transposed: false,
        }
    }

    /// Selects columns without copying. The result can be a right operand. A left operand needs adjacent runs.
    pub(crate) fn columns(self, columns: std::ops::Range<usize>) -> Self {
        assert!(
            !self.transposed && !columns.is_empty() && columns.end <= self.cols,
            "columns {columns:?} of a {}x{} matrix",
            self.rows,
            self.cols
        );
        let end = self.rows.saturating_sub(1) * self.stride + columns.end;
        Self {
            data: &self.data[columns.start..end],
            cols: columns.len(),
            ..self
        }
    }

    /// The transposed matrix over the same data.
    pub(crate) fn transposed(self) -> Self {
        Self {
            rows: self.cols,
            cols: self.rows,
            transposed: !self.transposed,
            ..self
        }
    }
}

#[derive(Clone, Copy, PartialEq, Eq)]
pub(crate) enum Threads {
    /// The calling thread alone: for callers that already split their work.
    Caller,
    /// The current rayon pool, for products large enough to be worth it.
    Pool,
}

impl Threads {
    /// Calls `each` with the number of every chunk of `len` scalars, and the chunk. The last chunk may be shorter.
    fn for_each_chunk<E: Send>(
        self,
        values: &mut [E],
        len: usize,
        each: impl Fn((usize, &mut [E])) + Sync + Send,
    ) {
        match self {
            Self::Caller => values.chunks_mut(len).enumerate().for_each(each),
            Self::Pool => {
                let chunks = values.par_chunks_mut(len).with_max_len(1);
                chunks.enumerate().for_each(each);
            }
        }
    }
}

/// A right operand, cut into panels of columns. Each panel is [k / DEPTH, columns, DEPTH], padded with zeros.
pub(crate) struct Panels<E: Element> {
    values: Buffer<E>,
    steps: usize,
    cols: usize,
    vecs: usize,
}

impl<E: Element> Panels<E> {
    /// Allocates panels for an operand of `steps` steps and `cols` columns.
    pub(crate) fn new<S: Simd<Element = E>>(_: S, steps: usize, cols: usize) -> Self {
        let vecs = tile_vecs::<S>(cols);
        let width = vecs * LANES;
        Self {
            values: Buffer::new(steps * width * E::DEPTH * cols.div_ceil(width)),
            steps,
            cols,
            vecs,
        }
    }

    /// Packs `b` [k, n] into panels.
    pub(crate) fn pack<S: Simd<Element = E>>(simd: S, b: Matrix<'_>, threads: Threads) -> Self {
        let mut panels = Self::new(simd, b.rows.div_ceil(E::DEPTH), b.cols);
        panels.fill(simd, b, b.rows, threads);
        panels
    }

    /// Packs `b` [parts * rows, n]. Each part begins with a new step. A transposed matrix is one part.
    pub(crate) fn fill<S: Simd<Element = E>>(
        &mut self,
        simd: S,
        b: Matrix<'_>,
        rows: usize,
        threads: Threads,
    ) {
        let width = self.vecs * LANES;
        let panel_len = self.steps * width * E::DEPTH;
        threads.for_each_chunk(&mut self.values, panel_len, |(panel, values)| {
            pack_panel(simd, b, rows, panel * width, width, values);
        });
    }

    /// The width of a panel in registers.
    pub(crate) const fn vecs(&self) -> usize {
        self.vecs
    }

    /// Multiplies any number of `left` rows of one run each into `out`, whose rows begin `stride` scalars apart.
    ///
    /// A block of a panel stays in the L1 cache while all rows are multiplied by it.
    pub(crate) fn multiply_rows<S: Simd<Element = E>>(
        &self,
        simd: S,
        rows: usize,
        left: LeftOperand<'_, E>,
        mode: Mode,
        out: &mut [f32],
        stride: usize,
    ) {
        let width = self.vecs * LANES;
        let panels = self.values.chunks_exact(self.steps * width * E::DEPTH);
        for (index, panel) in panels.enumerate() {
            let first = index * width;
            let blocks = panel.chunks(S::STEPS_IN_CACHE * width * E::DEPTH);
            for (block, panel) in blocks.enumerate() {
                let mode = if block == 0 { mode } else { Mode::Add };
                let start = left.start + block * S::STEPS_IN_CACHE * left.step_stride;
                let steps = panel.len() / (width * E::DEPTH);
                for (row, count) in row_tiles::<S>(rows, self.vecs) {
                    let left = LeftOperand {
                        start: start + row * left.row_stride,
                        steps,
                        ..left
                    };
                    let output = OutputTile {
                        out: &mut out[row * stride + first..],
                        row_stride: stride,
                        cols: width.min(self.cols - first),
                        vecs: self.vecs,
                        mode,
                    };
                    multiply_tile(simd, count, left, panel, output);
                }
            }
        }
    }

    /// Multiplies `rows` rows, at most one tile, into `out`, whose rows begin `stride` scalars apart.
    pub(crate) fn multiply<S: Simd<Element = E>>(
        &self,
        simd: S,
        rows: usize,
        left: LeftOperand<'_, E>,
        mode: Mode,
        out: &mut [f32],
        stride: usize,
    ) {
        let width = self.vecs * LANES;
        let panels = self.values.chunks_exact(self.steps * width * E::DEPTH);
        for (first, panel) in (0..).step_by(width).zip(panels) {
            let output = OutputTile {
                out: &mut out[first..],
                row_stride: stride,
                cols: width.min(self.cols - first),
                vecs: self.vecs,
                mode,
            };
            multiply_tile(simd, rows, left, panel, output);
        }
    }
}

vectorized! {
    /// Packs the columns of `b` from `first` on, in parts of `rows` rows, as one panel of this width.
    fn pack_panel<S>(
        simd,
        b: Matrix<'a>,
        rows: usize,
        first: usize,
        width: usize,
        panel: &'a mut [S::Element],
    ) {
        if b.transposed {
            return pack_transposed_panel(simd, b, first, width, panel);
        }
        let (cols, depth) = (width.min(b.cols - first), S::Element::DEPTH);
        let mut steps = panel.chunks_exact_mut(width * depth);
        for part in b.data.chunks(rows * b.stride) {
            for (lines, step) in part.chunks(b.stride * depth).zip(&mut steps) {
                let second = match depth {
                    1 => &[],
                    _ => lines.get(b.stride + first..).unwrap_or_default(),
                };
                let second = second.get(..cols).unwrap_or_default();
                S::Element::interleave(simd, &lines[first..first + cols], second, step);
            }
        }
    }
}

/// [`pack_panel`] for a transposed matrix: square blocks of steps are transposed in registers.
#[inline(always)]
fn pack_transposed_panel<S: Simd>(
    simd: S,
    b: Matrix<'_>,
    first: usize,
    width: usize,
    panel: &mut [S::Element],
) {
    let (k, depth) = (b.rows, S::Element::DEPTH);
    let (steps, cols) = (k.div_ceil(depth), width.min(b.cols - first));
    let columns = b.data[first * b.stride..].chunks(b.stride).take(cols);
    for step in (0..steps).step_by(LANES) {
        let run = step * depth..k.min((step + LANES) * depth);
        for col in (0..width).step_by(LANES) {
            let mut block = [[0; LANES]; LANES];
            let block_columns = columns.clone().skip(col).take(LANES);
            for (block, column) in block.iter_mut().zip(block_columns) {
                S::Element::round_steps(simd, &column[run.clone()], block);
            }
            simd.transpose(&mut block);
            for (at, block) in block.iter().enumerate().take(steps - step) {
                let to = &mut panel[((step + at) * width + col) * depth..][..LANES * depth];
                for (to, &bits) in to.chunks_exact_mut(depth).zip(block) {
                    S::Element::unpack(bits, to);
                }
            }
        }
    }
}

/// A left operand, laid out as tiles read it.
pub(crate) struct PackedRows<'a, E: Element> {
    values: Scalars<'a, E>,
    row_stride: usize,
    step_stride: usize,
    steps: usize,
}

impl<'a, E: Element> PackedRows<'a, E> {
    /// Packs the rows of `a` [m, k]: in place if they need no rounding, else as a rounded copy.
    pub(crate) fn pack<S: Simd<Element = E>>(simd: S, a: Matrix<'a>, threads: Threads) -> Self {
        let (m, k, depth) = (a.rows, a.cols, E::DEPTH);
        assert_eq!(a.data.len(), m * k, "columns of a matrix as a left operand");
        let steps = k.div_ceil(depth);
        let line = ALIGNMENT / size_of::<E>();
        let (row_stride, step_stride) = match a.transposed && !S::LEFT_STEPS_ADJACENT {
            false if S::LEFT_STEPS_ADJACENT => ((steps * depth).next_multiple_of(line), depth),
            false => (steps * depth, depth),
            true => (depth, m * depth),
        };
        let values = if let Some(values) = E::in_place(a.data) {
            Scalars::InPlace(values)
        } else {
            let mut values = Buffer::<E>::new(m * row_stride.max(steps * depth));
            let rows = (TASK_LEN / row_stride).max(1);
            if a.transposed && S::LEFT_STEPS_ADJACENT {
                let rows = rows.next_multiple_of(LANES);
                threads.for_each_chunk(&mut values, rows * row_stride, |(part, values)| {
                    transpose_rows(simd, a.transposed(), part * rows, row_stride, values);
                });
            } else if a.transposed {
                pack_steps(simd, a.transposed(), &mut values, threads);
            } else {
                threads.for_each_chunk(&mut values, rows * row_stride, |(part, values)| {
                    write_rows(simd, &a.data[part * rows * k..], k, row_stride, values);
                });
            }
            Scalars::Copied(values)
        };
        Self {
            values,
            row_stride,
            step_stride,
            steps,
        }
    }

    pub(crate) fn operand_from(&self, row: usize) -> LeftOperand<'_, E> {
        LeftOperand {
            start: row * self.row_stride,
            step_stride: self.step_stride,
            steps: self.steps,
            ..LeftOperand::rows(&self.values, self.row_stride)
        }
    }
}

/// Scalars that one task rounds.
const TASK_LEN: usize = 1 << 15;

vectorized! {
    /// Packs the columns of `a` [k, m] from the `first` on as rows of `stride`, a multiple of `LANES` steps, padded with zeros. Square
    /// blocks of steps are transposed in registers.
    fn transpose_rows<S>(
        simd,
        a: Matrix<'a>,
        first: usize,
        stride: usize,
        rows: &'a mut [S::Element],
    ) {
        let depth = S::Element::DEPTH;
        for (first, rows) in (first..).step_by(LANES).zip(rows.chunks_mut(LANES * stride)) {
            let cols = first..a.cols.min(first + LANES);
            let part = |k: usize| match k < a.rows {
                true => &a.data[k * a.stride..][cols.clone()],
                false => &[],
            };
            for at in (0..stride).step_by(LANES * depth) {
                let mut block = [[0; LANES]; LANES];
                for (k, block) in (at..).step_by(depth).zip(&mut block) {
                    let mut step = [S::Element::default(); 2 * LANES];
                    let step = &mut step[..LANES * depth];
                    S::Element::interleave(simd, part(k), part(k + 1), step);
                    for (bits, step) in block.iter_mut().zip(step.chunks_exact(depth)) {
                        *bits = S::Element::pack(step);
                    }
                }
                simd.transpose(&mut block);
                for (row, block) in rows.chunks_exact_mut(stride).zip(&block) {
                    let row = row[at..][..LANES * depth].chunks_exact_mut(depth);
                    for (step, &bits) in row.zip(block) {
                        S::Element::unpack(bits, step);
                    }
                }
            }
        }
    }
}

/// Packs all columns of `b` as one panel. On the pool, each task packs a share of the steps.
fn pack_steps<S: Simd>(simd: S, b: Matrix<'_>, values: &mut [S::Element], threads: Threads) {
    let (depth, cols) = (S::Element::DEPTH, b.cols);
    let len = (TASK_LEN / (cols * depth)).max(1) * cols * depth;
    threads.for_each_chunk(values, len, |(part, values)| {
        let data = &b.data[part * len..b.data.len().min((part + 1) * len)];
        let part = Matrix::new(data, data.len() / cols, cols);
        pack_panel(simd, part, part.rows, 0, cols, values);
    });
}
