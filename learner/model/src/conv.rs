//! The convolution as a candle operation with gradients, its batch split over the rayon pool.
//! It supports what the torso needs: the CPU, square kernels, no padding, no dilation, always bias and ReLU.
//!
//! candle's own backward pass is about 10 times slower on the CPU: it has no matrix product for the image's gradient, a
//! single thread for the bias's, and it always computes both.

use std::cell::RefCell;

use candle_core::{CpuStorage, CustomOp3, DType, Layout, Result, Shape, Tensor, bail};
use rayon::prelude::*;

use crate::im2col::{ConvGradients, ConvScratch, ConvShape, Images, backward, forward};
use crate::linear::{add_in_order, floats};

/// Images that one task takes. Fixed, so that sums are taken in the same order whatever the number of threads.
const TASK_IMAGES: usize = 16;

thread_local! {
    static SCRATCH: RefCell<ConvScratch> = RefCell::default();
}

/// relu(conv2d(images, weight) + bias) without padding, differentiable in all floating-point arguments.
///
/// `images` [B, H, W, C] u8 (scaled by 1/255, no gradient) or f32; `weight` [out, C, k, k] f32; `bias` [out] f32.
/// Result [B, (H - k) / stride + 1, (W - k) / stride + 1, out] f32, channels last. Where the result is 0 the gradient
/// is 0, as in PyTorch. Results and gradients have the same bits whatever the number of threads.
///
/// # Errors
/// Shapes that do not match, a kernel that is not square or larger than the image, a stride of 0, other types.
pub fn conv2d_relu(images: &Tensor, weight: &Tensor, bias: &Tensor, stride: usize) -> Result<Tensor> {
    let (_, height, width, channels) = images.dims4()?;
    let (channels_out, channels_in, kernel, kernel_width) = weight.dims4()?;
    if channels != channels_in || kernel != kernel_width || bias.dims() != [channels_out] {
        bail!(
            "convolution of images {:?} with weight {:?} and bias {:?}",
            images.shape(),
            weight.shape(),
            bias.shape()
        );
    }
    if stride == 0 || kernel == 0 || kernel > height.min(width) || channels * channels_out == 0 {
        bail!("convolution of images {:?} with weight {:?} and stride {stride}", images.shape(), weight.shape());
    }
    let shape = ConvShape { height, width, channels_in, channels_out, kernel, stride };
    images.contiguous()?.apply_op3(&weight.contiguous()?, &bias.contiguous()?, ConvRelu(shape))
}

struct ConvRelu(ConvShape);

impl CustomOp3 for ConvRelu {
    fn name(&self) -> &'static str {
        "conv2d-relu"
    }

    fn cpu_fwd(
        &self,
        images: &CpuStorage,
        images_layout: &Layout,
        weight: &CpuStorage,
        weight_layout: &Layout,
        bias: &CpuStorage,
        bias_layout: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        let shape = &self.0;
        let images = pixels(images, images_layout)?;
        let packed = shape.pack_weight(floats(weight, weight_layout)?);
        let bias = floats(bias, bias_layout)?;
        let batch = images.len() / shape.image_len();
        let mut maps = vec![0.0; batch * shape.map_len()];
        maps.par_chunks_mut(TASK_IMAGES * shape.map_len()).enumerate().for_each(|(task, maps)| {
            let images = task_images(shape, images, task);
            with_scratch(|scratch| forward(shape, images, &packed, bias, maps, scratch));
        });
        let dims = (batch, shape.out_height(), shape.out_width(), shape.channels_out);
        Ok((CpuStorage::F32(maps), dims.into()))
    }

    fn bwd(
        &self,
        images: &Tensor,
        weight: &Tensor,
        bias: &Tensor,
        maps: &Tensor,
        grad_maps: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>, Option<Tensor>)> {
        let shape = &self.0;
        let needs_images = images.dtype() == DType::F32 && images.track_op();
        let grad_maps = grad_maps.contiguous()?;

        let (images_storage, images_layout) = images.storage_and_layout();
        let (weight_storage, weight_layout) = weight.storage_and_layout();
        let (maps_storage, maps_layout) = maps.storage_and_layout();
        let (grad_storage, grad_layout) = grad_maps.storage_and_layout();
        let image_values = pixels(cpu(&images_storage)?, images_layout)?;
        let packed = shape.pack_weight(floats(cpu(&weight_storage)?, weight_layout)?);
        let map_values = floats(cpu(&maps_storage)?, maps_layout)?;
        let grad_values = floats(cpu(&grad_storage)?, grad_layout)?;

        let mut grad_images = vec![0.0f32; if needs_images { image_values.len() } else { 0 }];
        let image_parts: Vec<Option<&mut [f32]>> = if needs_images {
            grad_images.chunks_mut(TASK_IMAGES * shape.image_len()).map(Some).collect()
        } else {
            (0..map_values.len().div_ceil(TASK_IMAGES * shape.map_len())).map(|_| None).collect()
        };
        let task_len = TASK_IMAGES * shape.map_len();
        // One buffer a task: the packed weight's gradient, then the bias's.
        let sums: Vec<Vec<f32>> = map_values
            .par_chunks(task_len)
            .zip(grad_values.par_chunks(task_len))
            .zip(image_parts)
            .enumerate()
            .map(|(task, ((maps, grad_maps), grad_images))| {
                let mut sums = vec![0.0; shape.weight_len() + shape.channels_out];
                let (packed_sum, bias_sum) = sums.split_at_mut(shape.weight_len());
                let grads = ConvGradients { packed: packed_sum, bias: bias_sum, images: grad_images };
                let images = task_images(shape, image_values, task);
                with_scratch(|scratch| backward(shape, images, &packed, maps, grad_maps, grads, scratch));
                sums
            })
            .collect();
        let mut sum = add_in_order(sums, shape.weight_len() + shape.channels_out);
        let grad_bias = sum.split_off(shape.weight_len());

        let device = weight.device();
        let grad_images =
            if needs_images { Some(Tensor::from_vec(grad_images, images.shape(), device)?) } else { None };
        let grad_weight = Tensor::from_vec(shape.unpack_weight(&sum), weight.shape(), device)?;
        let grad_bias = Tensor::from_vec(grad_bias, bias.shape(), device)?;
        Ok((grad_images, Some(grad_weight), Some(grad_bias)))
    }
}

fn task_images<'a>(shape: &ConvShape, images: Images<'a>, task: usize) -> Images<'a> {
    let first = task * TASK_IMAGES * shape.image_len();
    images.slice(first..images.len().min(first + TASK_IMAGES * shape.image_len()))
}

/// Lends the thread's buffers to `work`, which must not start parallel work of its own.
fn with_scratch<R>(work: impl FnOnce(&mut ConvScratch) -> R) -> R {
    SCRATCH.with_borrow_mut(work)
}

fn pixels<'a>(storage: &'a CpuStorage, layout: &Layout) -> Result<Images<'a>> {
    match storage {
        CpuStorage::U8(bytes) => match layout.contiguous_offsets() {
            Some((start, end)) => Ok(Images::Bytes(&bytes[start..end])),
            None => bail!("images must be contiguous"),
        },
        _ => Ok(Images::Floats(floats(storage, layout)?)),
    }
}

/// The storage, which must be on the CPU.
pub(crate) fn cpu(storage: &candle_core::Storage) -> Result<&CpuStorage> {
    match storage {
        candle_core::Storage::Cpu(storage) => Ok(storage),
        _ => bail!("this operation runs on the CPU only"),
    }
}
