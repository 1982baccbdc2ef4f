//! Matrix products over slices, the output split over the rayon pool.
//! It knows nothing of layers.

use rayon::prelude::*;

use crate::kernels::panels::{Matrix, Panels, Rows, Threads};
use crate::kernels::precision::Precision;
use crate::kernels::units::{ForUnit, Mode, Unit, with_unit};

/// Rows of the output that one task computes. Fixed, so that a product's bits do not depend on the number of threads.
const TASK_ROWS: usize = 32;
/// Multiplications below which a product is not split.
const SPLIT_MIN: usize = 1 << 18;

/// Multiplies `a` [m, k] by `b` [k, n] into `out` [m, n], rows one after the other; operands are rounded to `precision`.
///
/// Each entry is summed in the order of k, in f32, whatever the number of threads; it is right to [`Precision::product_error`].
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
            .with_max_len(1)
            .enumerate()
            .for_each(|(index, out)| task(index * TASK_ROWS, out)),
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
