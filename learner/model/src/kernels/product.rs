//! Matrix products over slices, the output split over the rayon pool.
//! It knows nothing of layers.

use rayon::prelude::*;

use crate::kernels::panels::{Matrix, Panels, Rows, Threads};
use crate::kernels::precision::Precision;
use crate::kernels::units::{Element, ForUnit, Mode, Unit, with_unit};

/// Rows of the output that one task computes. Fixed, so that a product's bits do not depend on the number of threads.
const TASK_ROWS: usize = 32;
/// Multiplications below which a product is not split.
const SPLIT_MIN: usize = 1 << 18;

/// What a task does with its rows of the output: gets the number of the first one, and the rows one after the other.
pub(crate) type RowsWork<'a> = &'a (dyn Fn(usize, &mut [f32]) + Sync);

/// A product of `a` [m, k] and `b` [k, n], to be computed into rows of n scalars.
///
/// Operands are rounded to `precision`. Each entry is summed in the order of k, in f32, whatever the number of threads; it is right to
/// [`Precision::product_error`].
#[derive(Clone, Copy)]
pub(crate) struct Product<'a> {
    precision: Precision,
    a: Matrix<'a>,
    b: Matrix<'a>,
    threads: Threads,
    before: Option<RowsWork<'a>>,
    after: Option<RowsWork<'a>>,
}

impl<'a> Product<'a> {
    /// On the pool.
    ///
    /// # Panics
    /// If the shapes do not match.
    pub(crate) fn new(precision: Precision, a: Matrix<'a>, b: Matrix<'a>) -> Self {
        assert!(
            a.cols == b.rows,
            "product of {}x{} and {}x{} matrices",
            a.rows,
            a.cols,
            b.rows,
            b.cols
        );
        Self {
            precision,
            a,
            b,
            threads: Threads::Pool,
            before: None,
            after: None,
        }
    }

    /// By these threads.
    pub(crate) fn on(self, threads: Threads) -> Self {
        Self { threads, ..self }
    }

    /// Added to what `before` writes: biases, in the cache of the core that multiplies.
    pub(crate) fn added_to(self, before: RowsWork<'a>) -> Self {
        let before = Some(before);
        Self { before, ..self }
    }

    /// With `after` on each row that is done.
    pub(crate) fn then(self, after: RowsWork<'a>) -> Self {
        let after = Some(after);
        Self { after, ..self }
    }

    /// Into `out` [m, n].
    ///
    /// # Panics
    /// If `out` has another length.
    pub(crate) fn write(self, out: &mut [f32], mode: Mode) {
        assert!(
            out.len() == self.a.rows * self.b.cols,
            "a {}x{} product into {} scalars",
            self.a.rows,
            self.b.cols,
            out.len()
        );
        self.run(out, self.b.cols, mode);
    }

    /// Added to columns of `sums` from `first` on, whose rows are `stride` long.
    ///
    /// # Panics
    /// If they do not have these columns, or rows are worked on before or after.
    pub(crate) fn add_to_columns(self, sums: &mut [f32], stride: usize, first: usize) {
        let end = first + self.b.cols;
        assert!(
            sums.len() == self.a.rows * stride && end <= stride,
            "a {}x{} product into columns {first}..{end} of {} rows of {stride}",
            self.a.rows,
            self.b.cols,
            sums.len() / stride.max(1)
        );
        assert!(
            self.before.is_none() && self.after.is_none(),
            "rows have gaps"
        );
        let last = sums.len() - stride + end;
        self.run(&mut sums[first..last], stride, Mode::Add);
    }

    /// As a vector of its own.
    pub(crate) fn to_vec(self) -> Vec<f32> {
        struct Made<'a>(Product<'a>);
        impl ForUnit for Made<'_> {
            type Output = Vec<f32>;
            fn run<U: Unit>(self, unit: U) -> Vec<f32> {
                let Self(product) = self;
                let len = product.a.rows * product.b.cols;
                // Clearing memory takes a core about as long as laying out the operands.
                let (mut out, operands) =
                    product.both(|| vec![0.0; len], || Operands::new(unit, product));
                product.multiply(unit, operands, &mut out, product.b.cols, Mode::Replace);
                out
            }
        }
        with_unit(self.precision, Made(self))
    }

    /// Added to `sum` [m, n], if there is one.
    pub(crate) fn summed(self, sum: Option<Vec<f32>>) -> Vec<f32> {
        match sum {
            None => self.to_vec(),
            Some(mut sum) => {
                self.write(&mut sum, Mode::Add);
                sum
            }
        }
    }

    fn run(self, out: &mut [f32], stride: usize, mode: Mode) {
        struct Into<'a>(Product<'a>, &'a mut [f32], usize, Mode);
        impl ForUnit for Into<'_> {
            type Output = ();
            fn run<U: Unit>(self, unit: U) {
                let Self(product, out, stride, mode) = self;
                let operands = Operands::new(unit, product);
                product.multiply(unit, operands, out, stride, mode);
            }
        }
        with_unit(self.precision, Into(self, out, stride, mode));
    }

    /// Whether it is split, as it is large enough and may be.
    fn splits(self) -> bool {
        self.threads == Threads::Pool && self.a.rows * self.a.cols * self.b.cols >= SPLIT_MIN
    }

    /// Both at once, if it is split.
    fn both<A: Send, B: Send>(
        self,
        a: impl FnOnce() -> A + Send,
        b: impl FnOnce() -> B + Send,
    ) -> (A, B) {
        match self.splits() {
            true => rayon::join(a, b),
            false => (a(), b()),
        }
    }

    fn multiply<U: Unit>(
        self,
        unit: U,
        operands: Option<Operands<'a, U::Element>>,
        out: &mut [f32],
        stride: usize,
        mode: Mode,
    ) {
        if out.is_empty() {
            return;
        }
        let task = |first: usize, out: &mut [f32]| {
            let mode = match self.before {
                None => mode,
                Some(before) => {
                    before(first, out);
                    Mode::Add
                }
            };
            match &operands {
                Some(Operands { panels, rows }) => {
                    let count = out.len().div_ceil(stride);
                    panels.multiply_rows(unit, count, rows.left(first), mode, out, stride);
                }
                None if mode == Mode::Replace => out.fill(0.0),
                None => {}
            }
            if let Some(after) = self.after {
                after(first, out);
            }
        };
        if self.splits() {
            out.par_chunks_mut(TASK_ROWS * stride)
                .with_max_len(1)
                .enumerate()
                .for_each(|(index, out)| task(index * TASK_ROWS, out));
        } else {
            task(0, out);
        }
    }
}

/// A product's operands as a unit reads them.
struct Operands<'a, E: Element> {
    panels: Panels<E>,
    rows: Rows<'a, E>,
}

impl<'a, E: Element> Operands<'a, E> {
    /// Those of `product`, if there is anything to sum.
    fn new<U: Unit<Element = E>>(unit: U, product: Product<'a>) -> Option<Self> {
        let (a, b) = (product.a, product.b);
        if a.rows * a.cols * b.cols == 0 {
            return None;
        }
        let threads = match product.splits() {
            true => Threads::Pool,
            false => Threads::Caller,
        };
        let (panels, rows) = product.both(
            || Panels::pack(unit, b, threads),
            || Rows::pack(unit, a, threads),
        );
        Some(Self { panels, rows })
    }
}

/// [`Product`] into `out`, by `threads`.
pub(crate) fn multiply(
    precision: Precision,
    out: &mut [f32],
    mode: Mode,
    a: Matrix<'_>,
    b: Matrix<'_>,
    threads: Threads,
) {
    Product::new(precision, a, b).on(threads).write(out, mode);
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
