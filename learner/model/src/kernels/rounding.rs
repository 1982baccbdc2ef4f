//! Conversion of f32 values and bytes to operands of products, element by element, and transposition of images.

use crate::kernels::isa::{Element, LANES, vectorized};

vectorized! {
    /// Stores pixels in the first of `values`.
    pub(crate) fn store_bytes<S>(simd, bytes: &'a [u8], values: &'a mut [S::Element]) {
        S::Element::store_bytes(simd, bytes, values);
    }

    /// Rounds `floats` into `values`, which has the same length.
    pub(crate) fn store<S>(simd, floats: &'a [f32], values: &'a mut [S::Element]) {
        S::Element::store(simd, floats, values);
    }

    /// Rounds rows of `cols` scalars into rows of `stride`, padded with zeros.
    pub(crate) fn write_rows<S>(
        simd,
        values: &'a [f32],
        cols: usize,
        stride: usize,
        rows: &'a mut [S::Element],
    ) {
        let rows = rows.chunks_exact_mut(stride);
        for (row, values) in rows.zip(values.chunks_exact(cols)) {
            let (begin, end) = row.split_at_mut(cols);
            S::Element::store(simd, values, begin);
            end.fill(S::Element::default());
        }
    }

    /// Stores elements as operands of a sum over windows: [`Element::store_steps`].
    pub(crate) fn store_steps<S>(
        simd,
        values: &'a [S::Element],
        shift: usize,
        steps: &'a mut [S::Element],
    ) {
        S::Element::store_steps(simd, values, shift, steps);
    }

    /// Transposes an image [rows, cols], in square blocks that fit the registers.
    pub(crate) fn transpose<S>(
        simd,
        values: &'a [f32],
        rows: usize,
        cols: usize,
        transposed: &'a mut [f32],
    ) {
        for row in (0..rows).step_by(LANES) {
            for col in (0..cols).step_by(LANES) {
                let (height, width) = (LANES.min(rows - row), LANES.min(cols - col));
                let mut block = [[0; LANES]; LANES];
                for (line, block) in block.iter_mut().enumerate().take(height) {
                    let values = &values[(row + line) * cols + col..][..width];
                    for (bits, value) in block.iter_mut().zip(values) {
                        *bits = value.to_bits();
                    }
                }
                simd.transpose(&mut block);
                for (line, block) in block.iter().enumerate().take(width) {
                    let transposed = &mut transposed[(col + line) * rows + row..][..height];
                    for (value, &bits) in transposed.iter_mut().zip(block) {
                        *value = f32::from_bits(bits);
                    }
                }
            }
        }
    }
}
