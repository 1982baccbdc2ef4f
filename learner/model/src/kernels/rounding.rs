//! From f32 and bytes to the operands of products, element by element.

use crate::kernels::units::{Element, vectorized};

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
