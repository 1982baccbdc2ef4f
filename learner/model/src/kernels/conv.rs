//! A stack of convolutions as one candle operation with gradients. The batch is split over the rayon pool.
//! It supports only what the torso needs: CPU, square kernels, no padding, no dilation, always bias and ReLU.
//!
//! candle's own backward pass is about 10 times slower on the CPU. It has no matrix product for the image's gradient, sums
//! the bias's on one thread, and always computes both. The layers are one operation because candle adds every gradient to
//! fresh zeros. Here the maps between layers, and their gradients, stay in the cache of the core that computes them.

use candle_core::{DType, Result, Tensor, bail};

use crate::geometry::{ConvLayer, ConvShape};
use crate::kernels::candle::ConvLayerTensors;
use crate::kernels::isa::{AnySimd, Simd, with_simd};
use crate::kernels::operation::{Operation, apply_op2};
use crate::kernels::precision::Precision;
use crate::kernels::stack::{SavedActivations, Stack};
use crate::kernels::tasks::Tasks;
use crate::kernels::tensors::{Input, cpu_storage, values_of};

/// Images per task. The number is fixed, so that the order of additions does not depend on the number of threads.
const TASK_IMAGES: usize = 16;

/// relu(conv2d(images, weight) + bias) without padding: [`conv_stack`] of one layer.
pub fn conv2d_relu(
    images: &Tensor,
    weight: &Tensor,
    bias: &Tensor,
    stride: usize,
    precision: Precision,
) -> Result<Tensor> {
    conv_stack(images, &[(weight, bias, stride)], precision)
}

/// Convolutions without padding, each with bias and ReLU, differentiable in all floating-point arguments.
///
/// `images` [B, H, W, C] u8 (scaled by 1/255, no gradient) or f32. Each layer is (weight [out, in, k, k] f32, bias
/// [out] f32, stride) and turns [B, h, w, in] into [B, (h - k) / stride + 1, (w - k) / stride + 1, out], channels
/// last. The gradient at an output of exactly 0 is 0, as in PyTorch. Operands of products, and maps between layers,
/// are rounded to `precision`. The error of each layer's result, and of each parameter's gradient, is at most
/// [`Precision::product_error`] given its inputs. Their bits do not depend on the number of threads.
///
/// # Errors
/// No layer, shapes that do not match, a kernel that is not square or larger than its input, a stride of 0, other types.
pub fn conv_stack(
    images: &Tensor,
    layers: &[ConvLayerTensors<'_>],
    precision: Precision,
) -> Result<Tensor> {
    let (shapes, parameters) = flatten_layers(images, layers)?;
    let count = images.dim(0)?;
    let (height, width, channels) = shapes[shapes.len() - 1].output();
    with_simd!(AnySimd::fastest(precision), simd => {
        let stack = ConvStack { simd, shapes, count };
        apply_op2(stack, [images, &parameters], (count, height, width, channels))
    })
}

/// Returns the shapes of `layers` on `images`, and all parameters as one vector, because an operation has at most three arguments.
pub(crate) fn flatten_layers(
    images: &Tensor,
    layers: &[ConvLayerTensors<'_>],
) -> Result<(Vec<ConvShape>, Tensor)> {
    let (_, height, width, channels) = images.dims4()?;
    if layers.is_empty() {
        bail!("a stack of no convolutions");
    }
    let mut input = (height, width, channels);
    let (mut shapes, mut parameters) = (Vec::new(), Vec::new());
    for &(weight, bias, stride) in layers {
        let (out, weight_in, kernel, kernel_width) = weight.dims4()?;
        let fits = weight_in == input.2 && kernel == kernel_width && bias.dims() == [out];
        let layer = ConvLayer::new(out, kernel, stride);
        let Some(shape) = ConvShape::new(input, layer).filter(|_| fits) else {
            let (height, width, channels) = input;
            let (weight, bias) = (weight.shape(), bias.shape());
            bail!(
                "convolution of images {:?} with weight {weight:?}, bias {bias:?} and stride {stride}",
                [height, width, channels]
            );
        };
        input = shape.output();
        shapes.push(shape);
        parameters.extend([weight.flatten_all()?, bias.clone()]);
    }
    Ok((shapes, Tensor::cat(&parameters, 0)?))
}

/// Convolutions on a batch of images.
pub(crate) struct ConvStack<S: Simd> {
    pub(crate) simd: S,
    /// The shapes of the layers, at least one.
    pub(crate) shapes: Vec<ConvShape>,
    /// The number of images in the batch.
    pub(crate) count: usize,
}

impl<S: Simd> ConvStack<S> {
    pub(crate) fn last_shape(&self) -> &ConvShape {
        &self.shapes[self.shapes.len() - 1]
    }

    /// Prepares the layers of `parameters` for a forward pass, or for a `backward` pass. `image_grad`: the images need a gradient.
    pub(crate) fn prepare(&self, parameters: &[f32], backward: bool, image_grad: bool) -> Stack<S> {
        Stack::new(self.simd, &self.shapes, parameters, backward, image_grad)
    }

    pub(crate) fn tasks(&self) -> Tasks {
        Tasks {
            count: self.count,
            task_images: TASK_IMAGES,
            image_len: self.shapes[0].image_len(),
            map_len: self.last_shape().map_len(),
        }
    }
}

impl<S: Simd> Operation<2> for ConvStack<S> {
    const NAME: &'static str = "conv-stack";

    /// The maps of all layers but the last, for each task.
    type Saved = Vec<SavedActivations<S::Element>>;

    fn forward(&self, [images, parameters]: [Input<'_>; 2]) -> Result<(Vec<f32>, Self::Saved)> {
        let images = images.pixels()?;
        let layers = self.prepare(parameters.floats()?, false, false);
        let mut maps = vec![0.0; self.count * self.last_shape().map_len()];
        let run_task = |task, maps: &mut [f32]| layers.forward(images.slice(task), maps);
        let saved = self.tasks().forward(&mut maps, run_task);
        Ok((maps, saved))
    }

    fn backward(
        &self,
        [images, parameters]: [&Tensor; 2],
        saved: &Self::Saved,
        maps: &Tensor,
        grad_maps: &[f32],
    ) -> Result<[Option<Vec<f32>>; 2]> {
        let maps = values_of(maps)?;
        let maps = &maps[..];
        let image_grad = images.dtype() == DType::F32 && images.track_op();
        let (storage, layout) = images.storage_and_layout();
        let images = Input::new(cpu_storage(&storage)?, layout).pixels()?;
        let layers = self.prepare(&values_of(parameters)?, true, image_grad);
        let mut grad_images = vec![0.0; if image_grad { images.len() } else { 0 }];
        let tasks = self.tasks();
        let gradient = tasks.backward(&self.shapes, saved, &mut grad_images, |task, saved, to| {
            let (maps, grad_maps) = (&maps[task.maps.clone()], &grad_maps[task.maps]);
            let images = images.slice(task.images);
            layers.backward(images, saved, maps, grad_maps, to)
        });
        Ok([image_grad.then_some(grad_images), Some(gradient)])
    }
}
