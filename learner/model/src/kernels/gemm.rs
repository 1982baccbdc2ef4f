//! A bounds-checked matrix product over slices.
//! It does not allocate the result, and it knows nothing of layers.
//!
//! The product itself is the `gemm` crate's, whose only entry point takes raw pointers; this module is the one place of
//! the crate with unsafe code. candle's `matmul` is the same kernel, but it wants whole tensors: it would copy every tile
//! and could not accumulate into a gradient.

use std::ops::Range;

use rayon::prelude::*;

/// A matrix laid over a slice: element (i, j) is `data[i * row_stride + j * col_stride]`.
#[derive(Clone, Copy)]
pub(crate) struct Matrix<'a> {
    data: &'a [f32],
    rows: usize,
    cols: usize,
    row_stride: usize,
    col_stride: usize,
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
            row_stride: cols,
            col_stride: 1,
        }
    }

    /// The transposed matrix over the same data.
    pub(crate) fn transposed(self) -> Self {
        Self {
            data: self.data,
            rows: self.cols,
            cols: self.rows,
            row_stride: self.col_stride,
            col_stride: self.row_stride,
        }
    }

    /// Columns of the matrix.
    pub(crate) fn cols(&self) -> usize {
        self.cols
    }
}

/// Who computes a product.
#[derive(Clone, Copy)]
pub(crate) enum Threads {
    /// The calling thread alone: for callers that already split their work.
    Caller,
    /// The current rayon pool, for products large enough to be worth it.
    Pool,
}

/// What the product does to the output's old content.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(crate) enum Output {
    /// out = a b
    Replace,
    /// out = out + a b
    Add,
}

/// Columns of the output that one task computes; whole registers of any instruction set, and few enough that the `gemm` crate
/// reads the other operand in place instead of packing it.
const TASK_COLS: usize = 128;
/// Rows of the output that one task computes where there are far more rows than columns.
const TASK_ROWS: usize = 512;
/// Multiplications below which a product is not split.
const SPLIT_MIN: usize = 1 << 20;

/// Multiplies `a` [m, k] by `b` [k, n] into `out` [m, n], rows one after the other.
///
/// On the pool the output is split in blocks whose size follows from the shapes alone, so that the result has the same bits
/// whatever the number of threads. The `gemm` crate would split by threads, and pack an operand on one of them first.
///
/// # Panics
/// If the shapes do not match.
pub(crate) fn multiply(
    out: &mut [f32],
    mode: Output,
    a: Matrix<'_>,
    b: Matrix<'_>,
    threads: Threads,
) {
    let (m, k, n) = (a.rows, a.cols, b.cols);
    assert!(
        b.rows == k,
        "product of {m}x{k} and {}x{n} matrices",
        b.rows
    );
    assert!(
        out.len() == m * n,
        "product of {m}x{k} and {k}x{n} matrices into {} scalars",
        out.len()
    );
    if out.is_empty() {
        return;
    }
    let product = Product {
        out: out.as_mut_ptr(),
        mode,
        a,
        b,
    };
    match threads {
        Threads::Pool if m * k * n >= SPLIT_MIN && m >= 4 * n => {
            (0..m.div_ceil(TASK_ROWS)).into_par_iter().for_each(|task| {
                let first = task * TASK_ROWS;
                product.block(first..m.min(first + TASK_ROWS), 0..n);
            });
        }
        Threads::Pool if m * k * n >= SPLIT_MIN => {
            (0..n.div_ceil(TASK_COLS)).into_par_iter().for_each(|task| {
                let first = task * TASK_COLS;
                product.block(0..m, first..n.min(first + TASK_COLS));
            });
        }
        _ => product.block(0..m, 0..n),
    }
}

/// A product whose shapes match and whose output is exclusively borrowed by `multiply`, to be computed block by block.
struct Product<'a> {
    /// [a.rows, b.cols]
    out: *mut f32,
    mode: Output,
    a: Matrix<'a>,
    b: Matrix<'a>,
}

// SAFETY: the pointer is of the output that `multiply` has borrowed, and it gives each task a block of its own to write.
#[allow(unsafe_code, reason = "tasks write disjoint blocks of one output")]
unsafe impl Sync for Product<'_> {}

impl Product<'_> {
    /// Computes the block of the output in these rows and columns. No two calls at a time may share an element.
    #[allow(
        unsafe_code,
        reason = "the gemm crate's entry point takes raw pointers"
    )]
    fn block(&self, rows: Range<usize>, cols: Range<usize>) {
        let (m, n) = (self.a.rows, self.b.cols);
        assert!(
            rows.start < rows.end && rows.end <= m && cols.start < cols.end && cols.end <= n,
            "a block of rows {rows:?} and columns {cols:?} of a {m}x{n} matrix"
        );
        let (a, b) = (&self.a, &self.b);
        let a_block = &a.data[rows.start * a.row_stride..];
        let b_block = &b.data[cols.start * b.col_stride..];
        let stride = |stride: usize| {
            isize::try_from(stride).expect("strides are at most the length of a slice")
        };
        // SAFETY: `Matrix::new` checked that rows * cols scalars lie behind its pointer with strides (cols, 1), and
        // `transposed` swaps sizes and strides together, so every element of `a` and `b` is inside its slice; the block lies
        // in rows of `a` and columns of `b` that exist. `out` holds m * n initialised scalars, of which the block's, with
        // strides (n, 1), are inside and distinct; they overlap neither operand, as `out` is exclusively borrowed, nor
        // another task's block. f32 is a type that `gemm` has kernels for.
        unsafe {
            gemm::gemm(
                rows.len(),
                cols.len(),
                b.rows,
                self.out.add(rows.start * n + cols.start),
                1,
                stride(n),
                self.mode == Output::Add,
                a_block.as_ptr(),
                stride(a.col_stride),
                stride(a.row_stride),
                b_block.as_ptr(),
                stride(b.col_stride),
                stride(b.row_stride),
                1.0,
                1.0,
                false,
                false,
                false,
                gemm::Parallelism::None,
            );
        }
    }
}
