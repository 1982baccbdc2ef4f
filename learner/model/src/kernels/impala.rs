//! The stages of an IMPALA torso as one candle operation with gradients. The batch is split over the rayon pool.
//! It runs on the CPU only. The layer after f3 is a separate operation.

use candle_core::{Result, Tensor, bail};

use crate::geometry::{ConvShape, STAGE_CONVOLUTIONS, stage_shapes};
use crate::kernels::candle::BorderedTensors;
use crate::kernels::images::Pixels;
use crate::kernels::isa::{AnySimd, Simd, with_simd};
use crate::kernels::operation::{Operation, apply_op2};
use crate::kernels::precision::Precision;
use crate::kernels::stages::{Stages, Tape};
use crate::kernels::tasks::Tasks;
use crate::kernels::tensors::{Input, cpu_storage, values_of};

/// Images per task. The number is fixed, so that the order of additions does not depend on the number of threads.
const TASK_IMAGES: usize = 8;

/// Computes f3 [B, h, w, c] of `images` [B, H, W, C] u8, scaled by 1/255: stages of a convolution, a max pool
/// and two residual blocks x + conv(relu(conv(relu(x)))), then ReLU.
///
/// `layers` holds the weight [out, in, 3, 3] and the bias [out] of each convolution in the order of application. Convolutions
/// have zero padding. The pool is 3 x 3 with stride 2 and padding 1, which is never the largest. As in PyTorch, the first of
/// equal values in a window receives the gradient, and the gradient at a ReLU output of 0 is 0. Operands of products are
/// rounded to `precision`; residual sums are f32. The bits of results and gradients do not depend on the number of threads.
pub(crate) fn residual_stages(
    images: &Tensor,
    layers: &[BorderedTensors<'_>],
    precision: Precision,
) -> Result<Tensor> {
    let (count, height, width, channels) = images.dims4()?;
    let input = (height, width, channels);
    let widths = layers.chunks(STAGE_CONVOLUTIONS);
    let widths: Vec<usize> = widths.map(|it| it[0].1.elem_count()).collect();
    let fits = |((weight, bias), shape): (&BorderedTensors<'_>, &ConvShape)| {
        weight.dims() == [shape.channels_out, shape.channels_in, 3, 3]
            && bias.dims() == [shape.channels_out]
    };
    let (shapes, (rows, cols, width)) = stage_shapes(input, &widths);
    let is_whole = !layers.is_empty() && layers.len() == shapes.len() && images.elem_count() > 0;
    if !is_whole || !layers.iter().zip(&shapes).all(fits) {
        let weights: Vec<_> = layers.iter().map(|(weight, _)| weight.shape()).collect();
        bail!("stages on images {input:?} with weights {weights:?}");
    }
    let parameters = layers.iter().flat_map(|&(weight, bias)| [weight, bias]);
    let parameters: Result<Vec<_>> = parameters.map(Tensor::flatten_all).collect();
    let parameters = Tensor::cat(&parameters?, 0)?;
    with_simd!(AnySimd::fastest(precision), simd => {
        let operation = ResidualStages { simd, shapes, count };
        apply_op2(operation, [images, &parameters], (count, rows, cols, width))
    })
}

struct ResidualStages<S: Simd> {
    simd: S,
    shapes: Vec<ConvShape>,
    /// The number of images in the batch.
    count: usize,
}

impl<S: Simd> ResidualStages<S> {
    fn tasks(&self, stages: &Stages<S>) -> Tasks {
        Tasks {
            count: self.count,
            task_images: TASK_IMAGES,
            image_len: stages.image_len(),
            map_len: stages.output_len(),
        }
    }
}

fn bytes(images: Input<'_>) -> Result<&[u8]> {
    match images.pixels()? {
        Pixels::Bytes(bytes) => Ok(bytes),
        Pixels::Floats(_) => bail!("stages take images of bytes"),
    }
}

impl<S: Simd> Operation<2> for ResidualStages<S> {
    const NAME: &'static str = "residual-stages";

    /// The state of each task.
    type Saved = Vec<Tape<S::Element>>;

    fn forward(&self, [images, parameters]: [Input<'_>; 2]) -> Result<(Vec<f32>, Self::Saved)> {
        let images = bytes(images)?;
        let stages = Stages::new(self.simd, &self.shapes, parameters.floats()?, false);
        let mut f3 = vec![0.0; self.count * stages.output_len()];
        let saved = self.tasks(&stages).forward(&mut f3, |task, f3| {
            let mut tape = stages.allocate_tape(f3.len() / stages.output_len());
            stages.forward(&images[task], &mut tape, f3);
            tape
        });
        Ok((f3, saved))
    }

    fn backward(
        &self,
        [images, parameters]: [&Tensor; 2],
        saved: &Self::Saved,
        f3: &Tensor,
        grad_f3: &[f32],
    ) -> Result<[Option<Vec<f32>>; 2]> {
        let (storage, layout) = images.storage_and_layout();
        let images = bytes(Input::new(cpu_storage(&storage)?, layout))?;
        let f3 = values_of(f3)?;
        let f3 = &f3[..];
        let stages = Stages::new(self.simd, &self.shapes, &values_of(parameters)?, true);
        let tasks = self.tasks(&stages);
        let gradient = tasks.backward(&self.shapes, saved, &mut [], |task, tape, _| {
            let (f3, grad_f3) = (&f3[task.maps.clone()], &grad_f3[task.maps]);
            stages.backward(&images[task.images], tape, f3, grad_f3)
        });
        Ok([None, Some(gradient)])
    }
}
