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
    /// Stores pixels as operands of a sum over windows, as [`Element::steps_of_bytes`].
    pub(crate) fn store_steps_of_bytes<U>(
        unit,
        bytes: &'a [u8],
        shift: usize,
        steps: &'a mut [U::Element],
    ) {
        U::Element::steps_of_bytes(bytes, shift, steps);
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
    /// Pairs every scalar with the one `shift` further, or with 0 where the image ends before.
    pub(crate) fn pair_neighbours<U>(
        unit,
        values: &'a [U::Element],
        shift: usize,
        pairs: &'a mut [U::Element],
    ) {
        let later = values.get(shift..).unwrap_or_default();
        let (both, one) = pairs.split_at_mut(later.len() * 2);
        let (begin, end) = values.split_at(later.len());
        for ((pair, &value), &later) in both.chunks_exact_mut(2).zip(begin).zip(later) {
            (pair[0], pair[1]) = (value, later);
        }
        for (pair, &value) in one.chunks_exact_mut(2).zip(end) {
            (pair[0], pair[1]) = (value, U::Element::default());
        }
    }
}
