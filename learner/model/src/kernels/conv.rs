//! A stack of convolutions as one candle operation with gradients, its batch split over the rayon pool.
//! It supports what the torso needs: the CPU, square kernels, no padding, no dilation, always bias and ReLU.
//!
//! candle's own backward pass is about 10 times slower on the CPU: it has no matrix product for the image's gradient, a
//! single thread for the bias's, and it always computes both. The layers are one operation because candle adds every
//! gradient to fresh zeros; here the maps between layers, and their gradients, stay in the cache of the core at work.

use std::sync::OnceLock;

use candle_core::{CpuStorage, CustomOp2, DType, Layout, Result, Shape, Tensor, bail};
use rayon::prelude::*;

use crate::geometry::{ConvLayer, ConvShape};
use crate::kernels::buffer::Buffer;
use crate::kernels::candle::ConvLayerTensors;
use crate::kernels::images::Pixels;
use crate::kernels::isa::{AnySimd, Simd, with_simd};
use crate::kernels::linear::add_in_order;
use crate::kernels::precision::Precision;
use crate::kernels::rounding::transpose;
use crate::kernels::stack::{
    SavedActivations, layers, parameters_len, stack_backward, stack_forward, unpacked,
};
use crate::kernels::tensors::{cpu, floats, values_of};

/// Images that one task takes. Fixed, so that sums are taken in the same order whatever the number of threads.
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
    layers: &[ConvLayerTensors<'_>],
    precision: Precision,
) -> Result<Tensor> {
    let (shapes, parameters) = stack_of(images, layers)?;
    let images = images.contiguous()?;
    with_simd!(AnySimd::of(precision), simd => {
        images.apply_op2(&parameters, ConvStack::new(simd, shapes))
    })
}

/// The shapes of `layers` on `images`, and their parameters, which are small, as one vector: an operation has at most three arguments.
pub(crate) fn stack_of(
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

/// Convolutions of one pass, forward and then backward, on slices.
pub(crate) struct ConvStack<S: Simd> {
    simd: S,
    shapes: Vec<ConvShape>,
    /// Of each task, the maps of all layers but the last: what the forward pass leaves to the backward pass.
    saved: OnceLock<Vec<SavedActivations<S::Element>>>,
}

impl<S: Simd> ConvStack<S> {
    /// One that has not passed anything yet; `shapes` has a layer at least.
    pub(crate) fn new(simd: S, shapes: Vec<ConvShape>) -> Self {
        Self {
            simd,
            shapes,
            saved: OnceLock::new(),
        }
    }

    fn first(&self) -> &ConvShape {
        &self.shapes[0]
    }

    pub(crate) fn last(&self) -> &ConvShape {
        &self.shapes[self.shapes.len() - 1]
    }

    pub(crate) fn count(&self, images: Pixels<'_>) -> usize {
        images.len() / self.first().image_len()
    }

    /// The images of the task with this index.
    fn task_images<'a>(&self, images: Pixels<'a>, task: usize) -> Pixels<'a> {
        let task_len = TASK_IMAGES * self.first().image_len();
        images.slice(task * task_len..images.len().min((task + 1) * task_len))
    }

    /// Computes `maps` of `images`, and has `then` work on each task's, with as much of `room`, while they are in the cache.
    pub(crate) fn forward(
        &self,
        images: Pixels<'_>,
        parameters: &[f32],
        maps: &mut [f32],
        room: &mut [f32],
        then: &(dyn Fn(&[f32], &mut [f32]) + Sync),
    ) {
        let layers = layers(self.simd, &self.shapes, parameters, false, false);
        let task_len = TASK_IMAGES * self.last().map_len();
        let mut rooms = room.chunks_mut(task_len);
        let tasks: Vec<_> = maps
            .chunks_mut(task_len)
            .map(|maps| (maps, rooms.next().unwrap_or_default()))
            .collect();
        let saved = tasks
            .into_par_iter()
            .enumerate()
            .with_max_len(1)
            .map(|(task, (maps, room))| {
                let saved = stack_forward(self.simd, &layers, self.task_images(images, task), maps);
                then(maps, room);
                saved
            })
            .collect();
        let first = self.saved.set(saved).is_ok();
        assert!(first, "an operation passes forward once");
    }

    /// The gradient of the parameters for `grad_maps` in this layout, where `maps` are the pass's; the images' is written into
    /// `grad_images`, which is as long as they or empty.
    pub(crate) fn backward(
        &self,
        images: Pixels<'_>,
        parameters: &[f32],
        maps: &[f32],
        grad_maps: &[f32],
        layout: GradLayout,
        grad_images: &mut [f32],
    ) -> Vec<f32> {
        let wanted = !grad_images.is_empty();
        let layers = layers(self.simd, &self.shapes, parameters, true, wanted);
        let saved = self.saved.get().expect("a forward pass came before");
        let mut grad_parts = grad_images.chunks_mut(TASK_IMAGES * self.first().image_len());
        let grad_parts: Vec<Option<&mut [f32]>> = saved.iter().map(|_| grad_parts.next()).collect();
        let task_len = TASK_IMAGES * self.last().map_len();
        let sums = maps
            .par_chunks(task_len)
            .zip(grad_maps.par_chunks(task_len))
            .zip(saved.par_iter())
            .zip(grad_parts)
            .enumerate()
            .with_max_len(1)
            .map(|(task, (((maps, grad_maps), saved), grad_images))| {
                let images = self.task_images(images, task);
                let turned;
                let grad_maps = match layout {
                    GradLayout::Maps => grad_maps,
                    GradLayout::Flat => {
                        turned = self.maps_of_flat(grad_maps);
                        &turned
                    }
                };
                stack_backward(
                    self.simd,
                    &layers,
                    images,
                    saved,
                    maps,
                    grad_maps,
                    grad_images,
                )
            });
        let sums: Vec<_> = sums.collect();
        let sum = add_in_order(&sums, parameters_len(&self.shapes));
        unpacked(&self.shapes, &sum)
    }

    /// `maps` [n, locations, channels] as `flat` [n, channels, locations], the order of PyTorch's weights.
    pub(crate) fn flatten(&self, maps: &[f32], flat: &mut [f32]) {
        let (last, len) = (self.last(), self.last().map_len());
        for (maps, flat) in maps.chunks_exact(len).zip(flat.chunks_exact_mut(len)) {
            transpose(self.simd, maps, last.locations(), last.channels_out, flat);
        }
    }

    /// The inverse of [`ConvStack::flatten`].
    fn maps_of_flat(&self, flat: &[f32]) -> Buffer<f32> {
        let (last, len) = (self.last(), self.last().map_len());
        let mut maps = Buffer::new(flat.len());
        for (maps, flat) in maps.chunks_exact_mut(len).zip(flat.chunks_exact(len)) {
            transpose(self.simd, flat, last.channels_out, last.locations(), maps);
        }
        maps
    }
}

/// The order in which gradients of maps are.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(crate) enum GradLayout {
    /// [n, locations, channels], as maps are.
    Maps,
    /// [n, channels, locations], as they are flattened.
    Flat,
}

impl<S: Simd> CustomOp2 for ConvStack<S> {
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
        let (last, batch) = (self.last(), self.count(images));
        let mut maps = vec![0.0; batch * last.map_len()];
        self.forward(images, parameters, &mut maps, &mut [], &|_, _| {});
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
        let image_values = pixels(cpu(&images_storage)?, images_layout)?;
        let mut grad_images = vec![0.0f32; if needs_images { image_values.len() } else { 0 }];
        let grad_parameters = self.backward(
            image_values,
            &values_of(parameters)?,
            &values_of(maps)?,
            &values_of(&grad_maps)?,
            GradLayout::Maps,
            &mut grad_images,
        );
        let device = parameters.device();
        let grad_parameters = Tensor::from_vec(grad_parameters, parameters.shape(), device)?;
        let grad_images =
            needs_images.then(|| Tensor::from_vec(grad_images, images.shape(), device));
        Ok((grad_images.transpose()?, Some(grad_parameters)))
    }
}

pub(crate) fn pixels<'a>(storage: &'a CpuStorage, layout: &Layout) -> Result<Pixels<'a>> {
    match storage {
        CpuStorage::U8(bytes) => match layout.contiguous_offsets() {
            Some((start, end)) => Ok(Pixels::Bytes(&bytes[start..end])),
            None => bail!("images must be contiguous"),
        },
        _ => Ok(Pixels::Floats(floats(storage, layout)?)),
    }
}
