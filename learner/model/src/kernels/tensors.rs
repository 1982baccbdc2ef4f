//! Access to the scalars of candle's CPU tensors and storages.

use std::ops::{Deref, Range};

use candle_core::{CpuStorage, Layout, Result, Storage, StorageRef, Tensor, bail};

use crate::kernels::images::Pixels;

/// Returns the scalars of a contiguous f32 storage.
pub fn floats<'a>(storage: &'a CpuStorage, layout: &Layout) -> Result<&'a [f32]> {
    Ok(&storage.as_slice::<f32>()?[contiguous_range(layout)?])
}

/// An input of an operation.
#[derive(Clone, Copy)]
pub(crate) struct Input<'a> {
    storage: &'a CpuStorage,
    layout: &'a Layout,
}

impl<'a> Input<'a> {
    pub(crate) const fn new(storage: &'a CpuStorage, layout: &'a Layout) -> Self {
        Self { storage, layout }
    }

    pub(crate) fn floats(self) -> Result<&'a [f32]> {
        floats(self.storage, self.layout)
    }

    /// Returns contiguous images of u8 or f32.
    pub(crate) fn pixels(self) -> Result<Pixels<'a>> {
        match self.storage {
            CpuStorage::U8(bytes) => Ok(Pixels::Bytes(&bytes[contiguous_range(self.layout)?])),
            _ => self.floats().map(Pixels::Floats),
        }
    }
}

/// Returns the storage, or an error if it is not on the CPU.
pub(crate) fn cpu_storage(storage: &Storage) -> Result<&CpuStorage> {
    match storage {
        Storage::Cpu(storage) => Ok(storage),
        _ => bail!("this operation runs on the CPU only"),
    }
}

fn contiguous_range(layout: &Layout) -> Result<Range<usize>> {
    match layout.contiguous_offsets() {
        Some((start, end)) => Ok(start..end),
        None => bail!("a tensor of shape {:?} must be contiguous", layout.shape()),
    }
}

/// The scalars of a tensor. The tensor's storage is locked while this value lives.
pub struct Values<'a> {
    storage: StorageRef<'a>,
    range: Range<usize>,
}

/// Returns the scalars of a contiguous f32 tensor on the CPU.
pub fn values_of(tensor: &Tensor) -> Result<Values<'_>> {
    let (storage, layout) = tensor.storage_and_layout();
    cpu_storage(&storage)?.as_slice::<f32>()?;
    let range = contiguous_range(layout)?;
    Ok(Values { storage, range })
}

impl Deref for Values<'_> {
    type Target = [f32];

    fn deref(&self) -> &[f32] {
        match &*self.storage {
            Storage::Cpu(CpuStorage::F32(values)) => &values[self.range.clone()],
            _ => unreachable!("looked at by `values_of`"),
        }
    }
}
