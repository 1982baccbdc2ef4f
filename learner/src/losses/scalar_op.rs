//! A loss as a candle operation: the forward pass computes value and gradient together, the backward pass returns the gradient.
//! It works on the CPU only, and for one backward pass.

use std::sync::Mutex;

use candle_core::{CpuStorage, CustomOp1, Layout, Result, Shape, Tensor, bail};
use driml_model::floats;
use driml_protocol::lock;

/// Computes the scalar `loss(input)`, differentiable in `input`.
///
/// `loss` receives the input's values, row-major, writes their gradient into its second argument, of the same length, and returns
/// the value.
pub(super) fn scalar_op<F>(name: &'static str, input: &Tensor, loss: F) -> Result<Tensor>
where
    F: Fn(&[f32], &mut [f32]) -> f64 + Send + Sync + 'static,
{
    let op = ScalarOp {
        name,
        loss,
        gradient: Mutex::new(None),
    };
    input.contiguous()?.apply_op1(op)
}

struct ScalarOp<F> {
    name: &'static str,
    loss: F,
    /// Computed together with the value; the backward pass takes it.
    gradient: Mutex<Option<Vec<f32>>>,
}

impl<F: Fn(&[f32], &mut [f32]) -> f64 + Send + Sync> CustomOp1 for ScalarOp<F> {
    fn name(&self) -> &'static str {
        self.name
    }

    fn cpu_fwd(&self, storage: &CpuStorage, layout: &Layout) -> Result<(CpuStorage, Shape)> {
        let input = floats(storage, layout)?;
        let mut gradient = vec![0f32; input.len()];
        let value = (self.loss)(input, &mut gradient);
        *lock(&self.gradient) = Some(gradient);
        Ok((CpuStorage::F32(vec![value as f32]), Shape::from(())))
    }

    /// Returns the stored gradient times the scalar `grad_res`.
    fn bwd(&self, arg: &Tensor, _: &Tensor, grad_res: &Tensor) -> Result<Option<Tensor>> {
        let Some(mut gradient) = lock(&self.gradient).take() else {
            bail!("{} has one backward pass", self.name);
        };
        let factor = grad_res.to_scalar::<f32>()?;
        if factor != 1.0 {
            gradient.iter_mut().for_each(|g| *g *= factor);
        }
        Tensor::from_vec(gradient, arg.shape(), arg.device()).map(Some)
    }
}
