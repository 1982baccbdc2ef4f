//! An operation of this project and its conversion to a candle operation: scalars in, scalars out, on the CPU.
//! This module computes nothing itself.

use std::sync::OnceLock;

use candle_core::{CpuStorage, CustomOp2, CustomOp3, Layout, Result, Shape, Tensor};

use crate::kernels::tensors::{Input, values_of};

/// An operation with gradients on `N` tensors, used for one forward and one backward pass.
pub(crate) trait Operation<const N: usize>: Send + Sync + 'static {
    const NAME: &'static str;

    /// State that the forward pass keeps for the backward pass.
    type Saved: Send + Sync;

    fn forward(&self, inputs: [Input<'_>; N]) -> Result<(Vec<f32>, Self::Saved)>;

    /// Computes the gradients of the inputs that need one, given the gradient `grad_y` of the result `y`.
    fn backward(
        &self,
        inputs: [&Tensor; N],
        saved: &Self::Saved,
        y: &Tensor,
        grad_y: &[f32],
    ) -> Result<[Option<Vec<f32>>; N]>;
}

/// Applies `operation` to two tensors. `shape` is the shape of the result.
pub(crate) fn apply_op2<O: Operation<2>>(
    operation: O,
    [a, b]: [&Tensor; 2],
    shape: impl Into<Shape>,
) -> Result<Tensor> {
    let op = CandleOp::<O, 2>::new(operation, shape);
    a.contiguous()?.apply_op2(&b.contiguous()?, op)
}

/// Applies `operation` to three tensors, as [`apply_op2`].
pub(crate) fn apply_op3<O: Operation<3>>(
    operation: O,
    [a, b, c]: [&Tensor; 3],
    shape: impl Into<Shape>,
) -> Result<Tensor> {
    let op = CandleOp::<O, 3>::new(operation, shape);
    a.contiguous()?
        .apply_op3(&b.contiguous()?, &c.contiguous()?, op)
}

struct CandleOp<O: Operation<N>, const N: usize> {
    operation: O,
    shape: Shape,
    saved: OnceLock<O::Saved>,
}

impl<O: Operation<N>, const N: usize> CandleOp<O, N> {
    fn new(operation: O, shape: impl Into<Shape>) -> Self {
        Self {
            operation,
            shape: shape.into(),
            saved: OnceLock::new(),
        }
    }

    fn forward(&self, inputs: [Input<'_>; N]) -> Result<(CpuStorage, Shape)> {
        let (y, saved) = self.operation.forward(inputs)?;
        let first = self.saved.set(saved).is_ok();
        assert!(first, "an operation passes forward once");
        Ok((CpuStorage::F32(y), self.shape.clone()))
    }

    fn backward(
        &self,
        inputs: [&Tensor; N],
        y: &Tensor,
        grad_y: &Tensor,
    ) -> Result<[Option<Tensor>; N]> {
        let grad_y = grad_y.detach().contiguous()?;
        let grad_values = values_of(&grad_y)?;
        let saved = self.saved.get().expect("a forward pass came before");
        let gradients = self.operation.backward(inputs, saved, y, &grad_values)?;
        let mut tensors: [Option<Tensor>; N] = [const { None }; N];
        for ((tensor, gradient), input) in tensors.iter_mut().zip(gradients).zip(inputs) {
            if let Some(gradient) = gradient {
                let gradient = Tensor::from_vec(gradient, input.shape(), input.device())?;
                *tensor = Some(gradient);
            }
        }
        Ok(tensors)
    }
}

/// Implements candle's trait for an operation on this number of tensors, each a name and that of its layout.
macro_rules! custom_op {
    ($Op:ident, $count:literal, $($x:ident $layout:ident),+; $Gradients:ty) => {
        impl<O: Operation<$count>> $Op for CandleOp<O, $count> {
            fn name(&self) -> &'static str {
                O::NAME
            }

            fn cpu_fwd(&self, $($x: &CpuStorage, $layout: &Layout),+) -> Result<(CpuStorage, Shape)> {
                self.forward([$(Input::new($x, $layout)),+])
            }

            fn bwd(&self, $($x: &Tensor,)+ y: &Tensor, grad_y: &Tensor) -> Result<$Gradients> {
                Ok(self.backward([$($x),+], y, grad_y)?.into())
            }
        }
    };
}

custom_op!(CustomOp2, 2, a a_layout, b b_layout; (Option<Tensor>, Option<Tensor>));
custom_op!(CustomOp3, 3, a a_layout, b b_layout, c c_layout; (Option<Tensor>, Option<Tensor>, Option<Tensor>));
