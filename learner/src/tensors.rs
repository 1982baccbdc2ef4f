//! Conversions between bytes, slices and candle's tensors: states as the network's input, and the values of a tensor on the CPU.

use std::{borrow::Cow, cell::RefCell};

use candle_core::{CpuStorage, DType, Device, InplaceOp2, Layout, Tensor, bail};
use driml_model::{ModelConfig, floats};

use crate::error::{Result, UpdateError};

/// The bytes of states as a tensor [B, H, W, C] u8 on `device`, where the network converts them to floats.
pub(crate) fn states_tensor<'a>(
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

/// All values of an f32 tensor, in row-major order.
pub(crate) fn to_vec_f32(tensor: &Tensor) -> candle_core::Result<Vec<f32>> {
    tensor.flatten_all()?.to_vec1()
}

/// All values of a tensor as f64, in row-major order.
pub(crate) fn to_vec_f64(tensor: &Tensor) -> candle_core::Result<Vec<f64>> {
    tensor.to_dtype(DType::F64)?.flatten_all()?.to_vec1()
}

/// Calls `change` with the values of `tensor`, to change in place, and those of `other`. Both are on the CPU and equally long.
pub(crate) fn modify_in_place(
    tensor: &Tensor,
    other: &Tensor,
    change: impl FnMut(&mut [f32], &[f32]) -> candle_core::Result<()>,
) -> candle_core::Result<()> {
    // candle passes the operation by shared reference only.
    tensor.inplace_op2(other, &InPlaceOperation(RefCell::new(change)))
}

struct InPlaceOperation<F>(RefCell<F>);

impl<F: FnMut(&mut [f32], &[f32]) -> candle_core::Result<()>> InplaceOp2 for InPlaceOperation<F> {
    fn name(&self) -> &'static str {
        "change"
    }

    fn cpu_fwd(
        &self,
        storage: &mut CpuStorage,
        l1: &Layout,
        other: &CpuStorage,
        l2: &Layout,
    ) -> candle_core::Result<()> {
        let (CpuStorage::F32(values), Some((start, end))) = (storage, l1.contiguous_offsets())
        else {
            bail!("a tensor of shape {:?} is not contiguous f32", l1.shape());
        };
        let (values, other) = (&mut values[start..end], floats(other, l2)?);
        if values.len() != other.len() {
            bail!("{} values meet {}", values.len(), other.len());
        }
        (self.0.borrow_mut())(values, other)
    }
}

/// Reads a scalar loss; an error that names it if it is not finite.
pub(crate) fn read_finite(what: &str, loss: &Tensor) -> Result<f32> {
    let value = loss.to_scalar::<f32>()?;
    match value.is_finite() {
        true => Ok(value),
        false => Err(UpdateError::NonFinite(what.to_owned())),
    }
}
