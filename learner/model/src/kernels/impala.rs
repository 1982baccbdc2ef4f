//! The stages of an IMPALA torso as one candle operation with gradients, its batch split over the rayon pool.
//! It runs on the CPU only; the layer after f3 is another operation.

use std::sync::OnceLock;

use candle_core::{CpuStorage, CustomOp2, Layout, Result, Shape, Tensor, bail};
use rayon::prelude::*;

use crate::geometry::{STAGE_CONVOLUTIONS, stages};
use crate::kernels::candle::BorderedTensors;
use crate::kernels::conv::pixels;
use crate::kernels::images::Pixels;
use crate::kernels::isa::{AnySimd, Simd, with_simd};
use crate::kernels::linear::add_in_order;
use crate::kernels::precision::Precision;
use crate::kernels::stack::{parameters_len, unpacked};
use crate::kernels::stages::{Saved, Stages};
use crate::kernels::tensors::{cpu, floats, values_of};

/// Images that one task takes. Fixed, so that sums are taken in the same order whatever the number of threads.
const TASK_IMAGES: usize = 8;

/// f3 [B, h, w, c] of `images` [B, H, W, C] u8, which are scaled by 1/255: stages of a convolution, a max pool and two residual blocks
/// x + conv(relu(conv(relu(x)))), then ReLU.
///
/// `layers` has the weight [out, in, 3, 3] and the bias [out] of each convolution in the order in which they are applied. Convolutions
/// have a border of zeros; the pool is 3 x 3 of stride 2, with padding 1 that is never the largest. Of equal values in it the first takes
/// the gradient, and where a ReLU gives 0 the gradient is 0, as in PyTorch. Operands of products are rounded to `precision`; what residual
/// blocks add up is f32. Results and gradients have the same bits whatever the number of threads.
pub(crate) fn residual_stages(
    images: &Tensor,
    layers: &[BorderedTensors<'_>],
    precision: Precision,
) -> Result<Tensor> {
    let (_, height, width, channels) = images.dims4()?;
    let input = (height, width, channels);
    let widths = layers.chunks(STAGE_CONVOLUTIONS);
    let widths: Vec<usize> = widths.map(|it| it[0].1.elem_count()).collect();
    let fits = |((weight, bias), shape): (&BorderedTensors<'_>, &crate::geometry::ConvShape)| {
        weight.dims() == [shape.channels_out, shape.channels_in, 3, 3]
            && bias.dims() == [shape.channels_out]
    };
    let (shapes, _) = stages(input, &widths);
    let is_whole = !layers.is_empty() && layers.len() == shapes.len() && images.elem_count() > 0;
    if !is_whole || !layers.iter().zip(&shapes).all(fits) {
        let weights: Vec<_> = layers.iter().map(|(weight, _)| weight.shape()).collect();
        bail!("stages on images {input:?} with weights {weights:?}");
    }
    let parameters = layers.iter().flat_map(|&(weight, bias)| [weight, bias]);
    let parameters: Result<Vec<_>> = parameters.map(Tensor::flatten_all).collect();
    let (images, parameters) = (images.contiguous()?, Tensor::cat(&parameters?, 0)?);
    with_simd!(AnySimd::of(precision), simd => {
        let op = ResidualStages {
            simd,
            input,
            widths,
            saved: OnceLock::new(),
        };
        images.apply_op2(&parameters, op)
    })
}

struct ResidualStages<S: Simd> {
    simd: S,
    input: (usize, usize, usize),
    widths: Vec<usize>,
    /// Of each task, what the forward pass leaves to the backward pass.
    saved: OnceLock<Vec<Saved<S::Element>>>,
}

impl<S: Simd> ResidualStages<S> {
    fn stages(&self, parameters: &[f32], backward: bool) -> Stages<S> {
        Stages::new(self.simd, self.input, &self.widths, parameters, backward)
    }
}

fn bytes<'a>(storage: &'a CpuStorage, layout: &Layout) -> Result<&'a [u8]> {
    match pixels(storage, layout)? {
        Pixels::Bytes(bytes) => Ok(bytes),
        Pixels::Floats(_) => bail!("stages take images of bytes"),
    }
}

impl<S: Simd> CustomOp2 for ResidualStages<S> {
    fn name(&self) -> &'static str {
        "residual-stages"
    }

    fn cpu_fwd(
        &self,
        images: &CpuStorage,
        images_layout: &Layout,
        parameters: &CpuStorage,
        parameters_layout: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        let images = bytes(images, images_layout)?;
        let stages = self.stages(floats(parameters, parameters_layout)?, false);
        let count = images.len() / stages.image_len();
        let mut f3 = vec![0.0; count * stages.output_len()];
        let tasks = images.par_chunks(TASK_IMAGES * stages.image_len());
        let tasks = tasks.zip(f3.par_chunks_mut(TASK_IMAGES * stages.output_len()));
        let saved: Vec<_> = tasks
            .with_max_len(1)
            .map(|(images, f3)| {
                let mut saved = stages.saved(f3.len() / stages.output_len());
                stages.forward(images, &mut saved, f3);
                saved
            })
            .collect();
        let first = self.saved.set(saved).is_ok();
        assert!(first, "an operation passes forward once");
        let (height, width, channels) = stages.output();
        Ok((CpuStorage::F32(f3), (count, height, width, channels).into()))
    }

    fn bwd(
        &self,
        images: &Tensor,
        parameters: &Tensor,
        f3: &Tensor,
        grad_f3: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>)> {
        let grad_f3 = grad_f3.contiguous()?;
        let (images, images_layout) = images.storage_and_layout();
        let images = bytes(cpu(&images)?, images_layout)?;
        let (f3, grad) = (values_of(f3)?, values_of(&grad_f3)?);
        let stages = self.stages(&values_of(parameters)?, true);
        let saved = self.saved.get().expect("a forward pass came before");
        let task_len = TASK_IMAGES * stages.output_len();
        let tasks = images.par_chunks(TASK_IMAGES * stages.image_len());
        let tasks = tasks.zip(saved.par_iter());
        let tasks = tasks.zip(f3.par_chunks(task_len).zip(grad.par_chunks(task_len)));
        let sums = tasks
            .with_max_len(1)
            .map(|((images, saved), (f3, grad))| stages.backward(images, saved, f3, grad));
        let sums: Vec<_> = sums.collect();
        let (shapes, _) = crate::geometry::stages(self.input, &self.widths);
        let sum = unpacked(&shapes, &add_in_order(&sums, parameters_len(&shapes)));
        let gradient = Tensor::from_vec(sum, parameters.shape(), parameters.device())?;
        Ok((None, Some(gradient)))
    }
}
