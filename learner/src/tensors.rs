//! Between bytes, slices and candle's tensors: states as the network takes them, and the values behind a tensor on the CPU.

use std::borrow::Cow;

use candle_core::{CpuStorage, DType, Device, Layout, Tensor, bail};
use driml_model::ModelConfig;

use crate::error::UpdateError;

/// The bytes of states as a tensor [B, H, W, C] u8 on `device`: bytes travel there, they become numbers there.
pub(crate) fn states<'a>(
    model: &ModelConfig,
    bytes: impl Into<Cow<'a, [u8]>>,
    device: &Device,
) -> candle_core::Result<Tensor> {
    let bytes = bytes.into();
    let rows = bytes.len() / model.frame_len();
    let shape = (rows, model.height, model.width, model.input_channels);
    match bytes {
        Cow::Borrowed(bytes) => Tensor::from_slice(bytes, shape, device),
        Cow::Owned(bytes) => Tensor::from_vec(bytes, shape, device),
    }
}

/// All values of a tensor of f32, in their order.
pub(crate) fn flat(tensor: &Tensor) -> candle_core::Result<Vec<f32>> {
    tensor.flatten_all()?.to_vec1()
}

/// All values of a tensor as f64, in their order.
pub(crate) fn flat_f64(tensor: &Tensor) -> candle_core::Result<Vec<f64>> {
    tensor.to_dtype(DType::F64)?.flatten_all()?.to_vec1()
}

/// As [`floats`](driml_model::floats), to write.
pub(crate) fn floats_mut<'a>(
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

/// A loss as a number; an error that names it unless it is finite.
pub(crate) fn finite(what: &str, loss: &Tensor) -> Result<f32, UpdateError> {
    let value = loss.to_scalar::<f32>()?;
    match value.is_finite() {
        true => Ok(value),
        false => Err(UpdateError::NonFinite(what.to_owned())),
    }
}
