//! How a batch of images is cut into tasks, and a vector of parameters into those of convolutions.
//! It knows neither tensors nor instruction sets.

use std::ops::Range;

use rayon::prelude::*;

use crate::geometry::ConvShape;
use crate::kernels::buffer::Buffer;
use crate::kernels::linear::add_in_order;

/// A batch whose images are taken a few at a time.
pub(crate) struct Tasks {
    /// Images of the batch.
    pub(crate) count: usize,
    /// Images of a task. Fixed, so that sums are taken in the same order whatever the number of threads.
    pub(crate) images: usize,
    pub(crate) image_len: usize,
    pub(crate) map_len: usize,
}

/// Where the scalars of a task's images are, and those of their maps.
pub(crate) struct Task {
    pub(crate) images: Range<usize>,
    pub(crate) maps: Range<usize>,
}

impl Tasks {
    fn task(&self, index: usize) -> Task {
        let first = index * self.images;
        let end = self.count.min(first + self.images);
        Task {
            images: first * self.image_len..end * self.image_len,
            maps: first * self.map_len..end * self.map_len,
        }
    }

    /// Has `forward` make the maps of every task's images, whose scalars it gets the place of; what it leaves of each task.
    pub(crate) fn forward<T: Send>(
        &self,
        maps: &mut [f32],
        forward: impl Fn(Range<usize>, &mut [f32]) -> T + Sync,
    ) -> Vec<T> {
        maps.par_chunks_mut(self.images * self.map_len)
            .enumerate()
            .with_max_len(1)
            .map(|(index, maps)| forward(self.task(index).images, maps))
            .collect()
    }

    /// The gradient of the parameters of `shapes`, of which `backward` gives each task's part with weights as [k, k, in, out]. It gets what
    /// the forward pass left, and the task's gradients in `grad_images`, which has one for every scalar or none.
    pub(crate) fn backward<T: Sync>(
        &self,
        shapes: &[ConvShape],
        saved: &[T],
        grad_images: &mut [f32],
        backward: impl Fn(Task, &T, Option<&mut [f32]>) -> Buffer<f32> + Sync,
    ) -> Vec<f32> {
        let mut grad_images = grad_images.chunks_mut(self.images * self.image_len);
        let grad_images: Vec<_> = saved.iter().map(|_| grad_images.next()).collect();
        let tasks = saved.par_iter().zip(grad_images).enumerate();
        let sums: Vec<_> = tasks
            .with_max_len(1)
            .map(|(index, (saved, grad_images))| backward(self.task(index), saved, grad_images))
            .collect();
        unpacked(shapes, &add_in_order(&sums, parameters_len(shapes)))
    }
}

/// Scalars of all layers' parameters.
pub(crate) fn parameters_len(shapes: &[ConvShape]) -> usize {
    shapes.iter().map(ConvShape::parameters_len).sum()
}

/// The weight and the bias of each convolution, one after the other in `parameters`.
pub(crate) fn cut<'a>(shapes: &[ConvShape], mut parameters: &'a [f32]) -> Vec<[&'a [f32]; 2]> {
    let mut parts = Vec::with_capacity(shapes.len());
    for shape in shapes {
        let (own, rest) = parameters.split_at(shape.parameters_len());
        parts.push(own.split_at(shape.weight_len()).into());
        parameters = rest;
    }
    parts
}

/// As [`cut`].
pub(crate) fn cut_mut<'a>(
    shapes: &[ConvShape],
    mut parameters: &'a mut [f32],
) -> Vec<[&'a mut [f32]; 2]> {
    let mut parts = Vec::with_capacity(shapes.len());
    for shape in shapes {
        let (own, rest) = std::mem::take(&mut parameters).split_at_mut(shape.parameters_len());
        parts.push(own.split_at_mut(shape.weight_len()).into());
        parameters = rest;
    }
    parts
}

/// What `prepare` makes of each convolution's number, sizes, and weight and bias in `parameters`; on the pool, which all wait for.
pub(crate) fn prepared<C: Send>(
    shapes: &[ConvShape],
    parameters: &[f32],
    prepare: impl Fn(usize, ConvShape, [&[f32]; 2]) -> C + Sync,
) -> Vec<C> {
    let layers = shapes.par_iter().zip(cut(shapes, parameters)).enumerate();
    layers
        .with_max_len(1)
        .map(|(index, (&shape, parameters))| prepare(index, shape, parameters))
        .collect()
}

/// `sums` with the weights back as [out, in, k, k].
pub(crate) fn unpacked(shapes: &[ConvShape], sums: &[f32]) -> Vec<f32> {
    let mut result = vec![0.0; sums.len()];
    let (from, to) = (cut(shapes, sums), cut_mut(shapes, &mut result));
    for (shape, (from, to)) in shapes.iter().zip(from.into_iter().zip(to)) {
        let ([packed, bias], [weight, bias_to]) = (from, to);
        shape.unpack_weight(packed, weight);
        bias_to.copy_from_slice(bias);
    }
    result
}
