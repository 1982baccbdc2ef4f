//! A stack of convolutions as one candle operation with gradients, its batch split over the rayon pool.
//! It supports what the torso needs: the CPU, square kernels, no padding, no dilation, always bias and ReLU.
//!
//! candle's own backward pass is about 10 times slower on the CPU: it has no matrix product for the image's gradient, a
//! single thread for the bias's, and it always computes both. The layers are one operation because candle adds every
//! gradient to fresh zeros; here the maps between layers, and their gradients, stay in the cache of the core at work.

use std::sync::{Mutex, PoisonError};

use candle_core::{CpuStorage, CustomOp2, DType, Layout, Result, Shape, Tensor, bail};
use rayon::prelude::*;

use crate::geometry::{ConvLayer, ConvShape};
use crate::kernels::images::Pixels;
use crate::kernels::linear::{add_in_order, cpu, floats};
use crate::kernels::precision::Precision;
use crate::kernels::stack::{
    SavedActivations, layers, parameters_len, stack_backward, stack_forward, unpacked,
};
use crate::kernels::units::{ForUnit, Unit, with_unit};

/// Images that one task takes. Fixed, so that sums are taken in the same order whatever the number of threads.
const TASK_IMAGES: usize = 16;

/// relu(conv2d(images, weight) + bias) without padding: [`conv_stack`] of one layer.
///
/// # Errors
/// As for [`conv_stack`].
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
/// `images` [B, H, W, C] u8 (scaled by 1/255, no gradient) or f32. Each layer is (weight [out, in, k, k] f32, bias [out]
/// f32, stride) and turns [B, h, w, in] into [B, (h - k) / stride + 1, (w - k) / stride + 1, out], channels last. Where an
/// output is 0 its gradient is 0, as in PyTorch. Operands of products, and maps between layers, are rounded to `precision`.
/// Each result of a layer and each gradient of its parameters is right to [`Precision::product_error`] of what it is the sum of.
/// Results and gradients have the same bits whatever the number of threads.
///
/// # Errors
/// No layer, shapes that do not match, a kernel that is not square or larger than its input, a stride of 0, other types.
pub fn conv_stack(
    images: &Tensor,
    layers: &[(&Tensor, &Tensor, usize)],
    precision: Precision,
) -> Result<Tensor> {
    let (_, height, width, channels) = images.dims4()?;
    if layers.is_empty() {
        bail!("a stack of no convolutions");
    }
    let mut input = (height, width, channels);
    let (mut shapes, mut parameters) = (Vec::new(), Vec::new());
    for &(weight, bias, stride) in layers {
        let (out, weight_in, kernel, kernel_width) = weight.dims4()?;
        let fits = weight_in == input.2 && kernel == kernel_width && bias.dims() == [out];
        let layer = ConvLayer {
            out,
            kernel,
            stride,
        };
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
    // An operation has at most three arguments, so the parameters, which are small, travel as one vector.
    let parameters = Tensor::cat(&parameters, 0)?;
    let stack = Apply {
        images: &images.contiguous()?,
        parameters: &parameters,
        shapes,
    };
    with_unit(precision, stack)
}

struct Apply<'a> {
    images: &'a Tensor,
    parameters: &'a Tensor,
    shapes: Vec<ConvShape>,
}

impl ForUnit for Apply<'_> {
    type Output = Result<Tensor>;

    fn run<U: Unit>(self, unit: U) -> Result<Tensor> {
        let stack = ConvStack {
            unit,
            shapes: self.shapes,
            saved: Mutex::default(),
        };
        self.images.apply_op2(self.parameters, stack)
    }
}

struct ConvStack<U: Unit> {
    unit: U,
    shapes: Vec<ConvShape>,
    /// Of each task, the maps of all layers but the last: what the forward pass leaves to the backward pass.
    saved: Mutex<Vec<SavedActivations<U::Element>>>,
}

impl<U: Unit> ConvStack<U> {
    fn first(&self) -> &ConvShape {
        &self.shapes[0]
    }

    fn last(&self) -> &ConvShape {
        &self.shapes[self.shapes.len() - 1]
    }

    /// The images of the task with this index.
    fn task_images<'a>(&self, images: Pixels<'a>, task: usize) -> Pixels<'a> {
        let task_len = TASK_IMAGES * self.first().image_len();
        images.slice(task * task_len..images.len().min((task + 1) * task_len))
    }
}

impl<U: Unit> CustomOp2 for ConvStack<U> {
    fn name(&self) -> &'static str {
        "conv-stack"
    }

    fn cpu_fwd(
        &self,
        images: &CpuStorage,
        images_layout: &Layout,
        parameters: &CpuStorage,
        parameters_layout: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        let images = pixels(images, images_layout)?;
        let parameters = floats(parameters, parameters_layout)?;
        let layers = layers(self.unit, &self.shapes, parameters, false, false);
        let last = self.last();
        let batch = images.len() / self.first().image_len();
        let mut maps = vec![0.0; batch * last.map_len()];
        let tasks = maps
            .par_chunks_mut(TASK_IMAGES * last.map_len())
            .enumerate();
        let saved = tasks
            .with_max_len(1)
            .map(|(task, maps)| {
                stack_forward(self.unit, &layers, self.task_images(images, task), maps)
            })
            .collect();
        *self.saved.lock().unwrap_or_else(PoisonError::into_inner) = saved;
        let dims = (
            batch,
            last.out_height(),
            last.out_width(),
            last.channels_out,
        );
        Ok((CpuStorage::F32(maps), dims.into()))
    }

    fn bwd(
        &self,
        images: &Tensor,
        parameters: &Tensor,
        maps: &Tensor,
        grad_maps: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>)> {
        let needs_images = images.dtype() == DType::F32 && images.track_op();
        let grad_maps = grad_maps.contiguous()?;

        let (images_storage, images_layout) = images.storage_and_layout();
        let (parameters_storage, parameters_layout) = parameters.storage_and_layout();
        let (maps_storage, maps_layout) = maps.storage_and_layout();
        let (grad_storage, grad_layout) = grad_maps.storage_and_layout();
        let image_values = pixels(cpu(&images_storage)?, images_layout)?;
        let parameter_values = floats(cpu(&parameters_storage)?, parameters_layout)?;
        let layers = layers(
            self.unit,
            &self.shapes,
            parameter_values,
            true,
            needs_images,
        );
        let map_values = floats(cpu(&maps_storage)?, maps_layout)?;
        let grad_values = floats(cpu(&grad_storage)?, grad_layout)?;
        let saved = self.saved.lock().unwrap_or_else(PoisonError::into_inner);

        let mut grad_images = vec![0.0f32; if needs_images { image_values.len() } else { 0 }];
        let mut grad_parts = grad_images.chunks_mut(TASK_IMAGES * self.first().image_len());
        let grad_parts: Vec<Option<&mut [f32]>> = saved.iter().map(|_| grad_parts.next()).collect();
        let task_len = TASK_IMAGES * self.last().map_len();
        let sums = map_values
            .par_chunks(task_len)
            .zip(grad_values.par_chunks(task_len))
            .zip(saved.par_iter())
            .zip(grad_parts)
            .enumerate()
            .with_max_len(1)
            .map(|(task, (((maps, grad_maps), saved), grad_images))| {
                let images = self.task_images(image_values, task);
                stack_backward(
                    self.unit,
                    &layers,
                    images,
                    saved,
                    maps,
                    grad_maps,
                    grad_images,
                )
            });
        let sum = add_in_order(sums.collect(), parameters_len(&self.shapes));

        let device = parameters.device();
        let grad_parameters =
            Tensor::from_vec(unpacked(&self.shapes, &sum), parameters.shape(), device)?;
        let grad_images =
            needs_images.then(|| Tensor::from_vec(grad_images, images.shape(), device));
        Ok((grad_images.transpose()?, Some(grad_parameters)))
    }
}

fn pixels<'a>(storage: &'a CpuStorage, layout: &Layout) -> Result<Pixels<'a>> {
    match storage {
        CpuStorage::U8(bytes) => match layout.contiguous_offsets() {
            Some((start, end)) => Ok(Pixels::Bytes(&bytes[start..end])),
            None => bail!("images must be contiguous"),
        },
        _ => Ok(Pixels::Floats(floats(storage, layout)?)),
    }
}
