//! From f32 and bytes to the operands of products, element by element.

use crate::kernels::units::{Element, vectorized};

vectorized! {
    /// Stores pixels in the first of `values`.
    pub(crate) fn store_bytes<U>(unit, bytes: &'a [u8], values: &'a mut [U::Element]) {
        for (value, &byte) in values.iter_mut().zip(bytes) {
            *value = U::Element::of_byte(byte);
        }
    }
}

vectorized! {
    /// Rounds `floats` into the first of `values`.
    pub(crate) fn store<U>(unit, floats: &'a [f32], values: &'a mut [U::Element]) {
        for (value, &float) in values.iter_mut().zip(floats) {
            *value = U::Element::of(float);
        }
    }
}

vectorized! {
    /// Rounds rows of `cols` scalars into rows of whole steps, with zeros after them.
    pub(crate) fn write_rows<U>(unit, values: &'a [f32], cols: usize, rows: &'a mut [U::Element]) {
        let rows = rows.chunks_exact_mut(cols.next_multiple_of(U::Element::DEPTH));
        for (row, values) in rows.zip(values.chunks_exact(cols)) {
            let (begin, end) = row.split_at_mut(cols);
            for (to, &value) in begin.iter_mut().zip(values) {
                *to = U::Element::of(value);
            }
            end.fill(U::Element::default());
        }
    }
}
