//! Cuts a batch of images into tasks, and a vector of parameters into those of the convolutions.
//! This module knows neither tensors nor instruction sets.

use std::ops::Range;

use rayon::prelude::*;

use crate::geometry::ConvShape;
use crate::kernels::buffer::Buffer;
use crate::kernels::linear::add_in_order;

/// A batch whose images are taken a few at a time.
pub(crate) struct Tasks {
    /// The number of images in the batch.
    pub(crate) count: usize,
    /// Images per task. The number is fixed, so that the order of additions does not depend on the number of threads.
    pub(crate) task_images: usize,
    pub(crate) image_len: usize,
    pub(crate) map_len: usize,
}

/// The ranges of the scalars of a task's images and of their maps.
pub(crate) struct Task {
    pub(crate) images: Range<usize>,
    pub(crate) maps: Range<usize>,
}

impl Tasks {
    fn task(&self, index: usize) -> Task {
        let first = index * self.task_images;
        let end = self.count.min(first + self.task_images);
        Task {
            images: first * self.image_len..end * self.image_len,
            maps: first * self.map_len..end * self.map_len,
        }
    }

    /// Calls `forward` for each task with the range of its images' scalars and the maps to fill. Returns the results in task order.
    pub(crate) fn forward<T: Send>(
        &self,
        maps: &mut [f32],
        forward: impl Fn(Range<usize>, &mut [f32]) -> T + Sync,
    ) -> Vec<T> {
        maps.par_chunks_mut(self.task_images * self.map_len)
            .enumerate()
            .with_max_len(1)
            .map(|(index, maps)| forward(self.task(index).images, maps))
            .collect()
    }

    /// Returns the gradient of the parameters of `shapes`. `backward` computes each task's part, with weights as [k, k, in, out].
    /// It receives the task's `saved` and its part of `grad_images`, which is empty or has one scalar for each of the images'.
    pub(crate) fn backward<T: Sync>(
        &self,
        shapes: &[ConvShape],
        saved: &[T],
        grad_images: &mut [f32],
        backward: impl Fn(Task, &T, Option<&mut [f32]>) -> Buffer<f32> + Sync,
    ) -> Vec<f32> {
        let mut grad_images = grad_images.chunks_mut(self.task_images * self.image_len);
        let grad_images: Vec<_> = saved.iter().map(|_| grad_images.next()).collect();
        let tasks = saved.par_iter().zip(grad_images).enumerate();
        let sums: Vec<_> = tasks
            .with_max_len(1)
            .map(|(index, (saved, grad_images))| backward(self.task(index), saved, grad_images))
            .collect();
        unpack_weights(shapes, &add_in_order(&sums, parameters_len(shapes)))
    }
}

const ALL_PARAMETERS: &str = "a vector of parameters has those of each shape";

/// Returns the number of scalars in all layers' parameters.
pub(crate) fn parameters_len(shapes: &[ConvShape]) -> usize {
    shapes.iter().flat_map(ConvShape::parameter_lens).sum()
}

/// Cuts `parameters` into the weight and the bias of each convolution.
pub(crate) fn split_parameters<'a>(
    shapes: &[ConvShape],
    mut parameters: &'a [f32],
) -> Vec<[&'a [f32]; 2]> {
    let mut take = |len: usize| parameters.split_off(..len).expect(ALL_PARAMETERS);
    let parts = shapes.iter().map(ConvShape::parameter_lens);
    parts.map(|lens| lens.map(&mut take)).collect()
}

/// As [`split_parameters`], but mutable.
pub(crate) fn split_parameters_mut<'a>(
    shapes: &[ConvShape],
    mut parameters: &'a mut [f32],
) -> Vec<[&'a mut [f32]; 2]> {
    let mut take = |len: usize| parameters.split_off_mut(..len).expect(ALL_PARAMETERS);
    let parts = shapes.iter().map(ConvShape::parameter_lens);
    parts.map(|lens| lens.map(&mut take)).collect()
}

/// Calls `prepare` with each convolution's index, shape, weight and bias. Runs on the pool, because every task waits for the result.
pub(crate) fn prepare_layers<C: Send>(
    shapes: &[ConvShape],
    parameters: &[f32],
    prepare: impl Fn(usize, ConvShape, [&[f32]; 2]) -> C + Sync,
) -> Vec<C> {
    let parts = split_parameters(shapes, parameters);
    let layers = shapes.par_iter().zip(parts).enumerate();
    layers
        .with_max_len(1)
        .map(|(index, (&shape, parameters))| prepare(index, shape, parameters))
        .collect()
}

/// Returns `sums` with the weights reordered to [out, in, k, k].
pub(crate) fn unpack_weights(shapes: &[ConvShape], sums: &[f32]) -> Vec<f32> {
    let mut result = vec![0.0; sums.len()];
    let from = split_parameters(shapes, sums);
    let to = split_parameters_mut(shapes, &mut result);
    for (shape, (from, to)) in shapes.iter().zip(from.into_iter().zip(to)) {
        let ([packed, bias], [weight, bias_to]) = (from, to);
        shape.unpack_weight(packed, weight);
        bias_to.copy_from_slice(bias);
    }
    result
}
