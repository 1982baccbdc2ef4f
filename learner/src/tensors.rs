//! Tensors as slices: the values behind a candle storage, for operations that compute on the CPU themselves.

use candle_core::{CpuStorage, Layout, bail};

/// The f32 values of a contiguous tensor on the CPU.
pub(crate) fn slice<'a>(
    storage: &'a CpuStorage,
    layout: &Layout,
) -> candle_core::Result<&'a [f32]> {
    match layout.contiguous_offsets() {
        Some((start, end)) => Ok(&storage.as_slice::<f32>()?[start..end]),
        None => bail!("a tensor of shape {:?} is not contiguous", layout.shape()),
    }
}

/// [`slice`], to be written.
pub(crate) fn slice_mut<'a>(
    storage: &'a mut CpuStorage,
    layout: &Layout,
) -> candle_core::Result<&'a mut [f32]> {
    match (storage, layout.contiguous_offsets()) {
        (CpuStorage::F32(values), Some((start, end))) => Ok(&mut values[start..end]),
        _ => bail!(
            "a tensor of shape {:?} is not contiguous f32",
            layout.shape()
        ),
    }
}
