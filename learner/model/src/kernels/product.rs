//! Matrix products over slices, cut into tiles for a unit: operands rounded and packed, the output split over the rayon pool.
//! It knows nothing of layers.

use rayon::prelude::*;

use crate::kernels::buffer::Buffer;
use crate::kernels::precision::Precision;
use crate::kernels::rounding::write_rows;
use crate::kernels::units::{
    Columns, Element, ForUnit, LANES, Left, Mode, Unit, multiply_tile, row_tiles, tile_vecs,
    vectorized, with_unit,
};

/// A matrix laid over a slice: its rows one after the other, or its columns if it is transposed.
#[derive(Clone, Copy)]
pub(crate) struct Matrix<'a> {
    data: &'a [f32],
    rows: usize,
    cols: usize,
    transposed: bool,
}

impl<'a> Matrix<'a> {
    /// Rows one after the other, `data` [rows, cols].
    pub(crate) fn new(data: &'a [f32], rows: usize, cols: usize) -> Self {
        assert!(
            data.len() == rows * cols,
            "a {rows}x{cols} matrix over {} scalars",
            data.len()
        );
        Self {
            data,
            rows,
            cols,
            transposed: false,
        }
    }

    /// The transposed matrix over the same data.
    pub(crate) fn transposed(self) -> Self {
        Self {
            data: self.data,
            rows: self.cols,
            cols: self.rows,
            transposed: !self.transposed,
        }
    }
}

/// Who computes a product.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(crate) enum Threads {
    /// The calling thread alone: for callers that already split their work.
    Caller,
    /// The current rayon pool, for products large enough to be worth it.
    Pool,
}

/// Rows of the output that one task computes. Fixed, so that a product's bits do not depend on the number of threads.
const TASK_ROWS: usize = 32;
/// Steps of a panel that are multiplied by all rows of a task before the next: 32 KiB of the widest panel.
const STEPS_IN_CACHE: usize = 128;
/// Multiplications below which a product is not split.
const SPLIT_MIN: usize = 1 << 18;

/// Multiplies `a` [m, k] by `b` [k, n] into `out` [m, n], rows one after the other; operands are rounded to `precision`.
///
/// Each entry is summed in the order of k, in f32, whatever the number of threads.
///
/// # Panics
/// If the shapes do not match.
pub(crate) fn multiply(
    precision: Precision,
    out: &mut [f32],
    mode: Mode,
    a: Matrix<'_>,
    b: Matrix<'_>,
    threads: Threads,
) {
    struct Product<'a>(&'a mut [f32], Mode, Matrix<'a>, Matrix<'a>, Threads);
    impl ForUnit for Product<'_> {
        type Output = ();
        fn run<U: Unit>(self, unit: U) {
            let Self(out, mode, a, b, threads) = self;
            multiply_with(unit, out, mode, a, b, threads);
        }
    }
    with_unit(precision, Product(out, mode, a, b, threads));
}

fn multiply_with<U: Unit>(
    unit: U,
    out: &mut [f32],
    mode: Mode,
    a: Matrix<'_>,
    b: Matrix<'_>,
    threads: Threads,
) {
    let (m, k, n) = (a.rows, a.cols, b.cols);
    assert!(
        b.rows == k && out.len() == m * n,
        "product of {m}x{k} and {}x{n} matrices into {} scalars",
        b.rows,
        out.len()
    );
    if out.is_empty() {
        return;
    }
    if k == 0 {
        if mode == Mode::Replace {
            out.fill(0.0);
        }
        return;
    }
    let threads = if m * k * n >= SPLIT_MIN {
        threads
    } else {
        Threads::Caller
    };
    let panels = Panels::pack(unit, b, threads);
    let rows = Rows::pack(unit, a, threads);
    let task = |first: usize, out: &mut [f32]| {
        panels.multiply_rows(unit, out.len() / n, rows.left(first), mode, out);
    };
    match threads {
        Threads::Caller => task(0, out),
        Threads::Pool => out
            .par_chunks_mut(TASK_ROWS * n)
            .enumerate()
            .for_each(|(index, out)| task(index * TASK_ROWS, out)),
    }
}

/// A right operand, cut into panels of columns, each [k / DEPTH, columns, DEPTH] with zeros where it ends before they do.
pub(crate) struct Panels<E: Element> {
    values: Buffer<E>,
    steps: usize,
    cols: usize,
    vecs: usize,
}

impl<E: Element> Panels<E> {
    /// The panels of `b` [k, n].
    pub(crate) fn pack<U: Unit<Element = E>>(unit: U, b: Matrix<'_>, threads: Threads) -> Self {
        let vecs = tile_vecs::<U>(b.cols);
        let (steps, width) = (b.rows.div_ceil(E::DEPTH), vecs * LANES);
        let panel_len = steps * width * E::DEPTH;
        let mut values = Buffer::new(panel_len * b.cols.div_ceil(width));
        let pack = |panel: usize, values: &mut [E]| {
            pack_panel(unit, b, panel * width, width, values);
        };
        match threads {
            Threads::Caller => {
                for (panel, values) in values.chunks_exact_mut(panel_len).enumerate() {
                    pack(panel, values);
                }
            }
            Threads::Pool => values
                .par_chunks_exact_mut(panel_len)
                .enumerate()
                .for_each(|(panel, values)| pack(panel, values)),
        }
        Self {
            values,
            steps,
            cols: b.cols,
            vecs,
        }
    }

    /// Registers in the width of a panel.
    pub(crate) const fn vecs(&self) -> usize {
        self.vecs
    }

    /// Multiplies `rows` rows, no more than a tile's, into `out`, whose rows are this operand's columns long.
    pub(crate) fn multiply<U: Unit<Element = E>>(
        &self,
        unit: U,
        rows: usize,
        left: Left<'_, E>,
        mode: Mode,
        out: &mut [f32],
    ) {
        self.multiply_apart(unit, rows, left, mode, out, self.cols);
    }

    /// Multiplies any number of rows of one run into `out`, whose rows are this operand's columns long.
    ///
    /// A block of a panel stays in the first cache while all rows pass it.
    pub(crate) fn multiply_rows<U: Unit<Element = E>>(
        &self,
        unit: U,
        rows: usize,
        left: Left<'_, E>,
        mode: Mode,
        out: &mut [f32],
    ) {
        let width = self.vecs * LANES;
        let panels = self.values.chunks_exact(self.steps * width * E::DEPTH);
        for (index, panel) in panels.enumerate() {
            let first = index * width;
            let blocks = panel.chunks(STEPS_IN_CACHE * width * E::DEPTH);
            for (block, panel) in blocks.enumerate() {
                let mode = if block == 0 { mode } else { Mode::Add };
                let start = left.start + block * STEPS_IN_CACHE * left.step;
                let steps = panel.len() / (width * E::DEPTH);
                for (row, count) in row_tiles::<U>(rows, self.vecs) {
                    let left = Left {
                        start: start + row * left.row_stride,
                        steps,
                        ..left
                    };
                    let columns = Columns {
                        out: &mut out[row * self.cols + first..],
                        stride: self.cols,
                        cols: width.min(self.cols - first),
                        vecs: self.vecs,
                        mode,
                    };
                    multiply_tile(unit, count, left, panel, columns);
                }
            }
        }
    }

    /// [`Panels::multiply`] into rows of `out` that begin `stride` scalars apart.
    pub(crate) fn multiply_apart<U: Unit<Element = E>>(
        &self,
        unit: U,
        rows: usize,
        left: Left<'_, E>,
        mode: Mode,
        out: &mut [f32],
        stride: usize,
    ) {
        let width = self.vecs * LANES;
        let panels = self.values.chunks_exact(self.steps * width * E::DEPTH);
        for (index, panel) in panels.enumerate() {
            let first = index * width;
            multiply_tile(
                unit,
                rows,
                left,
                panel,
                Columns {
                    out: &mut out[first..],
                    stride,
                    cols: width.min(self.cols - first),
                    vecs: self.vecs,
                    mode,
                },
            );
        }
    }
}

vectorized! {
    /// Packs columns `first..` of `b` as one panel of this width.
    fn pack_panel<U>(
        unit,
        b: Matrix<'a>,
        first: usize,
        width: usize,
        panel: &'a mut [U::Element],
    ) {
        if b.transposed {
            return pack_transposed(unit, b, first, width, panel);
        }
        let (cols, depth) = (width.min(b.cols - first), U::Element::DEPTH);
        let steps = panel.chunks_exact_mut(width * depth);
        for (step, rows) in steps.zip(b.data.chunks(b.cols * depth)) {
            let part = |row: usize| {
                let row = rows.get(row * b.cols..).unwrap_or_default();
                row.get(first..first + cols).unwrap_or_default()
            };
            U::Element::join(part(0), part(1), step);
        }
    }
}

/// [`pack_panel`] of a matrix whose columns are its runs in memory: square blocks of steps are transposed in registers.
#[inline(always)]
fn pack_transposed<U: Unit>(
    unit: U,
    b: Matrix<'_>,
    first: usize,
    width: usize,
    panel: &mut [U::Element],
) {
    let (k, depth) = (b.rows, U::Element::DEPTH);
    let (steps, cols) = (k.div_ceil(depth), width.min(b.cols - first));
    let columns = &b.data[first * k..(first + cols) * k];
    for step in (0..steps).step_by(LANES) {
        let run = step * depth..k.min((step + LANES) * depth);
        for col in (0..width).step_by(LANES) {
            let mut block = [[0; LANES]; LANES];
            let block_columns = columns.chunks_exact(k).skip(col).take(LANES);
            for (block, column) in block.iter_mut().zip(block_columns) {
                let run = &column[run.clone()];
                if run.len() == LANES * depth {
                    for (bits, values) in block.iter_mut().zip(run.chunks_exact(depth)) {
                        *bits = U::Element::step(values);
                    }
                } else {
                    for (bits, values) in block.iter_mut().zip(run.chunks(depth)) {
                        *bits = U::Element::step(values);
                    }
                }
            }
            unit.transpose(&mut block);
            for (at, block) in block.iter().enumerate().take(steps - step) {
                let to = &mut panel[((step + at) * width + col) * depth..][..LANES * depth];
                for (to, &bits) in to.chunks_exact_mut(depth).zip(block) {
                    U::Element::unpack(bits, to);
                }
            }
        }
    }
}

/// A left operand as tiles read it.
struct Rows<'a, E: Element> {
    values: Operand<'a, E>,
    row_stride: usize,
    step: usize,
    steps: usize,
}

/// Where a left operand's scalars are.
enum Operand<'a, E: Element> {
    InPlace(&'a [E]),
    Packed(Buffer<E>),
}

impl<'a, E: Element> Rows<'a, E> {
    /// The rows of `a` [m, k]: where they are if that is possible, else a rounded copy.
    fn pack<U: Unit<Element = E>>(unit: U, a: Matrix<'a>, threads: Threads) -> Self {
        let (m, k, depth) = (a.rows, a.cols, E::DEPTH);
        let steps = k.div_ceil(depth);
        let (row_stride, step) = match a.transposed {
            false => (steps * depth, depth),
            true => (depth, m * depth),
        };
        let values = if let Some(values) = E::in_place(a.data) {
            Operand::InPlace(values)
        } else {
            let mut values = Buffer::new(m * steps * depth);
            if a.transposed {
                pack_steps(unit, a.transposed(), &mut values, threads);
            } else {
                pack_rows(unit, a.data, k, row_stride, &mut values, threads);
            }
            Operand::Packed(values)
        };
        Self {
            values,
            row_stride,
            step,
            steps,
        }
    }

    fn left(&self, row: usize) -> Left<'_, E> {
        Left {
            values: match &self.values {
                Operand::InPlace(values) => values,
                Operand::Packed(values) => values,
            },
            start: row * self.row_stride,
            row_stride: self.row_stride,
            step: self.step,
            steps: self.steps,
            run_stride: 0,
            runs: 1,
        }
    }
}

/// Scalars that one task rounds.
const TASK_LEN: usize = 1 << 15;

/// Rounds rows of `cols` scalars into rows of `stride`, with zeros after them.
fn pack_rows<U: Unit>(
    unit: U,
    data: &[f32],
    cols: usize,
    stride: usize,
    values: &mut [U::Element],
    threads: Threads,
) {
    let rows = (TASK_LEN / stride).max(1);
    let pack = |values: &mut [U::Element], data: &[f32]| {
        write_rows(unit, data, cols, values);
    };
    match threads {
        Threads::Caller => pack(values, data),
        Threads::Pool => values
            .par_chunks_mut(rows * stride)
            .zip(data.par_chunks(rows * cols))
            .for_each(|(values, data)| pack(values, data)),
    }
}

/// Packs all columns of `b` as one panel, a share of the steps on each thread.
fn pack_steps<U: Unit>(unit: U, b: Matrix<'_>, values: &mut [U::Element], threads: Threads) {
    let (depth, cols) = (U::Element::DEPTH, b.cols);
    let steps = (TASK_LEN / (cols * depth)).max(1);
    let pack = |values: &mut [U::Element], data: &[f32]| {
        let part = Matrix::new(data, data.len() / cols, cols);
        pack_panel(unit, part, 0, cols, values);
    };
    match threads {
        Threads::Caller => pack(values, b.data),
        Threads::Pool => values
            .par_chunks_mut(steps * cols * depth)
            .zip(b.data.par_chunks(steps * cols * depth))
            .for_each(|(values, data)| pack(values, data)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn values(len: usize, by: usize) -> Vec<f32> {
        (0..len).map(|i| (i * by % 23) as f32 / 4.0 - 2.7).collect()
    }

    /// [m, n] by its definition, of operands rounded to `precision`.
    fn plain(precision: Precision, a: &[f32], b: &[f32], [m, k, n]: [usize; 3]) -> Vec<f64> {
        let round = |x: f32| match precision {
            Precision::F32 => f64::from(x),
            Precision::Bf16 => half::bf16::from_f32(x).to_f64(),
        };
        let mut out = Vec::with_capacity(m * n);
        for i in 0..m {
            for j in 0..n {
                out.push(
                    (0..k)
                        .map(|at| round(a[i * k + at]) * round(b[at * n + j]))
                        .sum(),
                );
            }
        }
        out
    }

    fn transpose(values: &[f32], rows: usize, cols: usize) -> Vec<f32> {
        (0..values.len())
            .map(|at| values[at % rows * cols + at / rows])
            .collect()
    }

    #[test]
    fn products_of_odd_sizes_are_those_of_a_plain_loop() {
        for [m, k, n] in [
            [1, 1, 1],
            [7, 3, 17],
            [33, 65, 15],
            [70, 9, 33],
            [13, 130, 129],
            [100, 77, 64],
        ] {
            let (a, b) = (values(m * k, 7), values(k * n, 11));
            let (a_t, b_t) = (transpose(&a, m, k), transpose(&b, k, n));
            for precision in Precision::ALL {
                let wanted = plain(precision, &a, &b, [m, k, n]);
                for (mode, threads) in
                    [(Mode::Replace, Threads::Pool), (Mode::Add, Threads::Caller)]
                {
                    let start = if mode == Mode::Add { 2.0 } else { 0.0 };
                    for which in 0..4 {
                        let left = match which & 1 {
                            0 => Matrix::new(&a, m, k),
                            _ => Matrix::new(&a_t, k, m).transposed(),
                        };
                        let right = match which & 2 {
                            0 => Matrix::new(&b, k, n),
                            _ => Matrix::new(&b_t, n, k).transposed(),
                        };
                        let mut out = vec![2.0; m * n];
                        multiply(precision, &mut out, mode, left, right, threads);
                        for (got, wanted) in out.iter().zip(&wanted) {
                            let error = (f64::from(*got) - start - wanted).abs();
                            assert!(
                                error < 1e-3,
                                "{m}x{k}x{n} {precision} layout {which}: {got}, wanted {wanted}"
                            );
                        }
                    }
                }
            }
        }
    }

    #[test]
    fn an_empty_sum_is_zero() {
        let mut out = [3.0; 4];
        let (a, b) = (Matrix::new(&[], 2, 0), Matrix::new(&[], 0, 2));
        multiply(Precision::F32, &mut out, Mode::Add, a, b, Threads::Caller);
        assert_eq!(out, [3.0; 4]);
        multiply(
            Precision::F32,
            &mut out,
            Mode::Replace,
            a,
            b,
            Threads::Caller,
        );
        assert_eq!(out, [0.0; 4]);
    }
}
