//! Matrix products over slices. The output is split over the rayon pool.
//! This module knows nothing of layers.

use rayon::prelude::*;

use crate::kernels::isa::{AnySimd, Element, Mode, Simd, with_simd};
use crate::kernels::panels::{Matrix, PackedRows, Panels, Threads};
use crate::kernels::precision::Precision;

/// Output rows that one task computes. The number is fixed, so that a product's bits do not depend on the number of threads.
const TASK_ROWS: usize = 32;
/// Multiplications below which a product stays on one thread.
const SPLIT_MIN: usize = 1 << 18;

/// Work on a task's finished output rows. It receives the index of the first row, and the rows one after the other.
pub(crate) type RowsCallback<'a> = &'a (dyn Fn(usize, &mut [f32]) + Sync);

/// A product of `a` [m, k] and `b` [k, n], to be computed into rows of n scalars.
///
/// Operands are rounded to `precision`. Each entry is summed in f32 in the order of k, whatever the number of
/// threads. Its error is at most [`Precision::product_error`].
#[derive(Clone, Copy)]
pub(crate) struct Product<'a> {
    precision: Precision,
    a: Matrix<'a>,
    b: Matrix<'a>,
    threads: Threads,
    biases: Option<&'a [f32]>,
    after: Option<RowsCallback<'a>>,
}

impl<'a> Product<'a> {
    /// Creates a product that is computed on the rayon pool.
    pub(crate) fn new(precision: Precision, a: Matrix<'a>, b: Matrix<'a>) -> Self {
        let (rows, cols) = (a.rows, b.cols);
        assert_eq!(a.cols, b.rows, "terms of a {rows}x{cols} product");
        Self {
            precision,
            a,
            b,
            threads: Threads::Pool,
            biases: None,
            after: None,
        }
    }

    pub(crate) fn with_threads(self, threads: Threads) -> Self {
        Self { threads, ..self }
    }

    /// Adds the product to `biases` [groups, n]. Each bias row serves an equal share of consecutive output
    /// rows. It is copied in the cache of the core that multiplies.
    pub(crate) fn with_biases(self, biases: &'a [f32]) -> Self {
        let (rows, cols) = (self.a.rows, self.b.cols);
        let groups = biases.len() / cols;
        assert!(
            biases.len() == groups * cols && rows.is_multiple_of(groups),
            "{} biases for {rows} rows of {cols}",
            biases.len()
        );
        let biases = Some(biases);
        Self { biases, ..self }
    }

    /// Calls `after` on the finished rows of each task.
    pub(crate) fn then(self, after: RowsCallback<'a>) -> Self {
        let after = Some(after);
        Self { after, ..self }
    }

    /// Computes the product into `out` [m, n].
    pub(crate) fn write(self, out: &mut [f32], mode: Mode) {
        let len = self.a.rows * self.b.cols;
        assert_eq!(out.len(), len, "the scalars of a product");
        self.run(out, self.b.cols, mode);
    }

    /// Adds the product to the columns of `sums` from `first` on. The rows of `sums` are `stride` long.
    pub(crate) fn add_to_columns(self, sums: &mut [f32], stride: usize, first: usize) {
        let (rows, end) = (self.a.rows, first + self.b.cols);
        assert_eq!(sums.len(), rows * stride, "{rows} rows of {stride}");
        assert!(end <= stride, "columns {first}..{end} of {stride}");
        let is_plain = self.biases.is_none() && self.after.is_none();
        assert!(is_plain, "rows have gaps");
        let last = sums.len() - stride + end;
        self.run(&mut sums[first..last], stride, Mode::Add);
    }

    pub(crate) fn to_vec(self) -> Vec<f32> {
        let len = self.a.rows * self.b.cols;
        with_simd!(AnySimd::fastest(self.precision), simd => {
            // Clearing the output takes a core about as long as packing the operands, so both run at once.
            let (mut out, operands) = self.run_both(|| vec![0.0; len], || Operands::new(simd, self));
            self.multiply(simd, operands, &mut out, self.b.cols, Mode::Replace);
            out
        })
    }

    /// Returns `sum` [m, n] plus the product, or the product alone if `sum` is `None`.
    pub(crate) fn added_to_sum(self, sum: Option<Vec<f32>>) -> Vec<f32> {
        match sum {
            None => self.to_vec(),
            Some(mut sum) => {
                self.write(&mut sum, Mode::Add);
                sum
            }
        }
    }

    fn run(self, out: &mut [f32], stride: usize, mode: Mode) {
        with_simd!(AnySimd::fastest(self.precision), simd => {
            self.multiply(simd, Operands::new(simd, self), out, stride, mode);
        });
    }

    /// Whether the product is split over the pool, because it is large enough and may use the pool.
    fn is_split(self) -> bool {
        self.threads == Threads::Pool && self.a.rows * self.a.cols * self.b.cols >= SPLIT_MIN
    }

    /// Runs both closures, in parallel if the product is split.
    fn run_both<A: Send, B: Send>(
        self,
        a: impl FnOnce() -> A + Send,
        b: impl FnOnce() -> B + Send,
    ) -> (A, B) {
        match self.is_split() {
            true => rayon::join(a, b),
            false => (a(), b()),
        }
    }

    fn multiply<S: Simd>(
        self,
        simd: S,
        operands: Option<Operands<'a, S::Element>>,
        out: &mut [f32],
        stride: usize,
        mode: Mode,
    ) {
        if out.is_empty() {
            return;
        }
        let task = |first: usize, out: &mut [f32]| {
            let mode = match self.biases {
                None => mode,
                Some(biases) => {
                    let each = self.a.rows / (biases.len() / stride);
                    for (row, to) in (first..).zip(out.chunks_exact_mut(stride)) {
                        to.copy_from_slice(&biases[row / each * stride..][..stride]);
                    }
                    Mode::Add
                }
            };
            match &operands {
                Some(Operands { panels, rows }) => {
                    let count = out.len().div_ceil(stride);
                    panels.multiply_rows(simd, count, rows.operand_from(first), mode, out, stride);
                }
                None if mode == Mode::Replace => out.fill(0.0),
                None => {}
            }
            if let Some(after) = self.after {
                after(first, out);
            }
        };
        if self.is_split() {
            out.par_chunks_mut(TASK_ROWS * stride)
                .with_max_len(1)
                .enumerate()
                .for_each(|(index, out)| task(index * TASK_ROWS, out));
        } else {
            task(0, out);
        }
    }
}

/// A product's operands, packed for an instruction set.
struct Operands<'a, E: Element> {
    panels: Panels<E>,
    rows: PackedRows<'a, E>,
}

impl<'a, E: Element> Operands<'a, E> {
    /// Packs the operands of `product`; `None` if there is nothing to sum.
    fn new<S: Simd<Element = E>>(simd: S, product: Product<'a>) -> Option<Self> {
        let (a, b) = (product.a, product.b);
        if a.rows * a.cols * b.cols == 0 {
            return None;
        }
        let threads = match product.is_split() {
            true => Threads::Pool,
            false => Threads::Caller,
        };
        let (panels, rows) = product.run_both(
            || Panels::pack(simd, b, threads),
            || PackedRows::pack(simd, a, threads),
        );
        Some(Self { panels, rows })
    }
}

#[cfg(test)]
mod tests {
    use half::bf16;

    use super::*;
    use crate::kernels::buffer::Pooled;

    fn values(len: usize, by: usize) -> Vec<f32> {
        (0..len).map(|i| (i * by % 23) as f32 / 4.0 - 2.7).collect()
    }

    /// Computes the product [m, n] by definition, with operands rounded to `precision`.
    fn plain(precision: Precision, a: &[f32], b: &[f32], [m, k, n]: [usize; 3]) -> Vec<f64> {
        let round = |x: f32| match precision {
            Precision::F32 => f64::from(x),
            Precision::Bf16 => half::bf16::from_f32(x).to_f64(),
        };
        let entry = |i: usize, j: usize| {
            let terms = (0..k).map(|at| round(a[i * k + at]) * round(b[at * n + j]));
            terms.sum::<f64>()
        };
        (0..m * n).map(|at| entry(at / n, at % n)).collect()
    }

    fn transpose(values: &[f32], rows: usize, cols: usize) -> Vec<f32> {
        (0..values.len())
            .map(|at| values[at % rows * cols + at / rows])
            .collect()
    }

    /// Compares a product, both written and added to an output, with `wanted` on every instruction set.
    fn check(product: Product<'_>, wanted: &[f64]) {
        for simd in AnySimd::all_available(product.precision) {
            for (mode, start, threads) in [
                (Mode::Replace, 0.0, Threads::Pool),
                (Mode::Add, 2.0, Threads::Caller),
            ] {
                let (product, mut out) = (product.with_threads(threads), vec![2.0; wanted.len()]);
                // Recycled memory has old content, so that missing zeros are noticed.
                for memory in bf16::pool().lock().unwrap().iter_mut() {
                    memory.fill(bf16::NAN);
                }
                with_simd!(simd, simd => {
                    let operands = Operands::new(simd, product);
                    product.multiply(simd, operands, &mut out, product.b.cols, mode);
                });
                for (got, wanted) in out.iter().zip(wanted) {
                    let error = (f64::from(*got) - start - wanted).abs();
                    let max = 1e-3 + 1e-4 * wanted.abs();
                    assert!(error < max, "{got}, wanted {wanted}, start {start}");
                }
            }
        }
    }

    #[test]
    fn products_of_odd_sizes_are_those_of_a_plain_loop_on_every_instruction_set() {
        // The last three products are split, and so is their packing. The sums of the last are longer than what one task rounds.
        for [m, k, n] in [
            [1, 1, 1],
            [7, 3, 17],
            [33, 65, 15],
            [70, 9, 33],
            [13, 130, 129],
            [100, 77, 64],
            [300, 260, 9],
            [3, (1 << 15) + 1, 5],
        ] {
            let (a, b) = (values(m * k, 7), values(k * n, 11));
            let (a_t, b_t) = (transpose(&a, m, k), transpose(&b, k, n));
            let lefts = [Matrix::new(&a, m, k), Matrix::new(&a_t, k, m).transposed()];
            let rights = [Matrix::new(&b, k, n), Matrix::new(&b_t, n, k).transposed()];
            for precision in Precision::ALL {
                let wanted = plain(precision, &a, &b, [m, k, n]);
                for left in lefts {
                    for right in rights {
                        check(Product::new(precision, left, right), &wanted);
                    }
                }
            }
        }
    }

    #[test]
    fn rows_start_from_biases_and_are_worked_on_after() {
        // One product that is not split, and one that is.
        for [m, k, n] in [[3, 2, 5], [100, 77, 64]] {
            let (a, b) = (values(m * k, 7), values(k * n, 11));
            let values: Vec<f32> = (0..m * n).map(|at| (at / n) as f32).collect();
            let after =
                |_: usize, rows: &mut [f32]| rows.iter_mut().for_each(|value| *value *= 2.0);
            let product =
                Product::new(Precision::F32, Matrix::new(&a, m, k), Matrix::new(&b, k, n));
            let plain = product.to_vec();
            let edged = product.with_biases(&values).then(&after).to_vec();
            for (at, (edged, plain)) in edged.iter().zip(&plain).enumerate() {
                let wanted = 2.0 * (plain + (at / n) as f32);
                assert!((edged - wanted).abs() < 1e-3, "{edged}, wanted {wanted}");
            }
            assert_eq!(product.added_to_sum(None), plain);
            let twice: Vec<f32> = plain.iter().map(|value| 2.0 * value).collect();
            assert_eq!(product.added_to_sum(Some(plain)), twice);
        }
    }
}
