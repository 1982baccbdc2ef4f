//! A stack of convolutions as one candle operation with gradients. The batch is split over the rayon pool.
//! It supports only what the torso needs: CPU, square kernels, no padding, no dilation, always bias and ReLU.
//! [`Stack`] passes one task's images through the layers, on slices; `convolution` computes each layer.
//!
//! candle's own backward pass is about 10 times slower on the CPU. It has no matrix product for the image's gradient, sums
//! the bias's on one thread, and always computes both. The layers are one operation because candle adds every gradient to
//! fresh zeros. Here the maps between layers, and their gradients, stay in the cache of the core that computes them.

use candle_core::{DType, Result, Tensor, bail};

use crate::geometry::{ConvLayer, ConvShape};
use crate::kernels::buffer::Buffer;
use crate::kernels::candle::ConvLayerTensors;
use crate::kernels::convolution::{Convolution, backward, forward};
use crate::kernels::images::{Images, Pixels};
use crate::kernels::isa::{AnySimd, Element, Simd, with_simd};
use crate::kernels::operation::{Operation, apply_op2};
use crate::kernels::precision::Precision;
use crate::kernels::tasks::{Tasks, parameters_len, prepare_layers, split_parameters_mut};
use crate::kernels::tensors::{Input, cpu_storage, values_of};

/// Images per task. The number is fixed, so that the order of additions does not depend on the number of threads.
const TASK_IMAGES: usize = 16;

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

/// The maps of all layers but the last, which the forward pass keeps for the backward pass.
pub(crate) type SavedActivations<E> = Vec<Buffer<E>>;

/// Convolutions, their parameters packed for the kernels.
pub(crate) struct Stack<S: Simd> {
    simd: S,
    layers: Vec<Convolution<S::Element>>,
}

impl<S: Simd> Stack<S> {
    /// Prepares at least one layer. `parameters` holds each layer's weight [out, in, k, k], then its bias [out]. `backward` says whether
    /// a backward pass follows. It computes the inputs' gradients of all layers but the first, and of the first if `image_grad`.
    pub(crate) fn new(
        simd: S,
        shapes: &[ConvShape],
        parameters: &[f32],
        backward: bool,
        image_grad: bool,
    ) -> Self {
        let layers = prepare_layers(shapes, parameters, |index, shape, [weight, bias]| {
            let backward = backward && (index > 0 || image_grad);
            Convolution::new(simd, shape, weight, bias, backward)
        });
        Self { simd, layers }
    }

    pub(crate) fn image_len(&self) -> usize {
        self.layers[0].shape.image_len()
    }

    /// Passes `images` through the layers and writes the last layer's output into `maps`.
    pub(crate) fn forward<M: Element>(
        &self,
        images: Pixels<'_>,
        maps: &mut [M],
    ) -> SavedActivations<S::Element> {
        let Some((last, inner)) = self.layers.split_last() else {
            unreachable!("a stack has at least one layer")
        };
        let count = maps.len() / last.shape.map_len();
        let mut saved: SavedActivations<S::Element> = Vec::with_capacity(inner.len());
        for layer in inner {
            let input = input_of(images, saved.last());
            let mut output = Buffer::<S::Element>::new(count * layer.shape.map_len());
            forward(self.simd, layer, input, &mut output);
            saved.push(output);
        }
        forward(self.simd, last, input_of(images, saved.last()), maps);
        saved
    }

    /// Computes the gradients for `grad_maps`, the gradient of the last layer's output `maps`. `saved` is from [`Stack::forward`].
    ///
    /// Returns the parameters' gradients: for each layer the weight's [k, k, in, out], then the bias's. Adds
    /// the images' gradient to `grad_images`, if given.
    pub(crate) fn backward(
        &self,
        images: Pixels<'_>,
        saved: &[Buffer<S::Element>],
        maps: &[f32],
        grad_maps: &[f32],
        mut grad_images: Option<&mut [f32]>,
    ) -> Buffer<f32> {
        let simd = self.simd;
        let shapes: Vec<_> = self.layers.iter().map(|layer| layer.shape).collect();
        let mut sums = Buffer::new(parameters_len(&shapes));
        // The gradient of the current layer's output. `None` for the last layer, whose gradient is `grad_maps`.
        let mut grad_output: Option<Buffer<f32>> = None;
        let parts = split_parameters_mut(&shapes, &mut sums);
        let layers = self.layers.iter().zip(parts);
        for (index, (layer, sums)) in layers.enumerate().rev() {
            let before = index.checked_sub(1).map(|before| &saved[before]);
            let input = input_of(images, before);
            let mut grad_input = before.map(|maps| Buffer::<f32>::zeros(maps.len()));
            let to = match &mut grad_input {
                Some(grad) => Some(&mut grad[..]),
                None => grad_images.take(),
            };
            match (saved.get(index), &grad_output) {
                (Some(output), Some(grad)) => backward(simd, layer, input, output, grad, sums, to),
                // The last layer's output is f32.
                _ => backward(simd, layer, input, maps, grad_maps, sums, to),
            }
            grad_output = grad_input;
        }
        // Products with bytes are scaled only now.
        let scale = Images::<S::Element>::Pixels(images).scale();
        if scale != 1.0 {
            for sum in &mut sums[..shapes[0].weight_len()] {
                *sum *= scale;
            }
        }
        sums
    }
}

/// Returns the input of a layer: the maps of the layer before it, or the images.
fn input_of<'a, E: Element>(images: Pixels<'a>, before: Option<&'a Buffer<E>>) -> Images<'a, E> {
    before.map_or(Images::Pixels(images), |maps| Images::Maps(maps))
}
