//! A bounds-checked matrix product over slices.
//! It does not allocate the result, and it knows nothing of layers.
//!
//! The product itself is the `gemm` crate's, whose only entry point takes raw pointers; this module is the one place of
//! the crate with unsafe code. candle's `matmul` is the same kernel, but it wants whole tensors: it would copy every tile
//! and could not accumulate into a gradient.

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
    /// The current rayon pool, for products large enough to be worth it. The result has the same bits as with `Caller`.
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

/// Multiplies `a` [m, k] by `b` [k, n] into `out` [m, n], rows one after the other.
///
/// # Panics
/// If the shapes do not match.
#[allow(
    unsafe_code,
    reason = "the gemm crate's entry point takes raw pointers"
)]
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
    let stride =
        |stride: usize| isize::try_from(stride).expect("strides are at most the length of a slice");
    let parallelism = match threads {
        Threads::Caller => gemm::Parallelism::None,
        Threads::Pool => gemm::Parallelism::Rayon(rayon::current_num_threads()),
    };
    // SAFETY: `Matrix::new` checked that rows * cols scalars lie behind its pointer with strides (cols, 1), and
    // `transposed` swaps sizes and strides together, so every element of `a` and `b` is inside its slice. `out` is
    // exclusively borrowed, so it overlaps neither, holds m * n initialised scalars, and with strides (n, 1) its elements
    // are distinct, as parallel writes need. f32 is a type that `gemm` has kernels for.
    unsafe {
        gemm::gemm(
            m,
            n,
            k,
            out.as_mut_ptr(),
            1,
            stride(n),
            mode == Output::Add,
            a.data.as_ptr(),
            stride(a.col_stride),
            stride(a.row_stride),
            b.data.as_ptr(),
            stride(b.col_stride),
            stride(b.row_stride),
            1.0,
            1.0,
            false,
            false,
            false,
            parallelism,
        );
    }
}
