//! From f32 and bytes to the operands of products, element by element; images turned.

use crate::kernels::units::{Element, LANES, vectorized};

vectorized! {
    /// Stores pixels in the first of `values`.
    pub(crate) fn store_bytes<U>(unit, bytes: &'a [u8], values: &'a mut [U::Element]) {
        U::Element::store_bytes(unit, bytes, values);
    }
}

vectorized! {
    /// Stores pixels as operands of a sum over windows, as [`Element::steps_of_bytes`].
    pub(crate) fn store_steps_of_bytes<U>(
        unit,
        bytes: &'a [u8],
        shift: usize,
        steps: &'a mut [U::Element],
    ) {
        U::Element::steps_of_bytes(unit, bytes, shift, steps);
    }
}

vectorized! {
    /// Rounds `floats` into `values`, which is as long.
    pub(crate) fn store<U>(unit, floats: &'a [f32], values: &'a mut [U::Element]) {
        U::Element::store(unit, floats, values);
    }
}

vectorized! {
    /// Rounds rows of `cols` scalars into rows of whole steps, with zeros after them.
    pub(crate) fn write_rows<U>(unit, values: &'a [f32], cols: usize, rows: &'a mut [U::Element]) {
        let rows = rows.chunks_exact_mut(cols.next_multiple_of(U::Element::DEPTH));
        for (row, values) in rows.zip(values.chunks_exact(cols)) {
            let (begin, end) = row.split_at_mut(cols);
            U::Element::store(unit, values, begin);
            end.fill(U::Element::default());
        }
    }
}

vectorized! {
    /// Elements as operands of a sum over windows, as [`Element::steps_of`].
    pub(crate) fn store_steps_of<U>(
        unit,
        values: &'a [U::Element],
        shift: usize,
        steps: &'a mut [U::Element],
    ) {
        U::Element::steps_of(unit, values, shift, steps);
    }
}

vectorized! {
    /// Transposes an image [rows, cols], in square blocks that fit the registers.
    pub(crate) fn transpose<U>(
        unit,
        values: &'a [f32],
        rows: usize,
        cols: usize,
        turned: &'a mut [f32],
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
                unit.transpose(&mut block);
                for (line, block) in block.iter().enumerate().take(width) {
                    let turned = &mut turned[(col + line) * rows + row..][..height];
                    for (value, &bits) in turned.iter_mut().zip(block) {
                        *value = f32::from_bits(bits);
                    }
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::kernels::precision::Precision;
    use crate::kernels::units::{AnyUnit, on_unit};

    #[test]
    fn every_unit_turns_images_of_any_size() {
        for [rows, cols] in [[1, 1], [16, 64], [17, 15], [3, 70], [33, 32], [5, 0]] {
            let values: Vec<f32> = (0..rows * cols).map(|at| at as f32).collect();
            for unit in Precision::ALL.into_iter().flat_map(AnyUnit::every) {
                let mut turned = vec![f32::NAN; values.len()];
                on_unit!(unit, unit => transpose(unit, &values, rows, cols, &mut turned));
                for (at, &value) in turned.iter().enumerate() {
                    assert_eq!(value, values[at % rows * cols + at / rows]);
                }
            }
        }
    }
}
