//! A stack of convolutions over one task's images, forward and backward, on slices.
//! This module knows no tensors: `conv` splits the batch and `convolution` computes each layer.

use crate::geometry::ConvShape;
use crate::kernels::buffer::Buffer;
use crate::kernels::convolution::{Convolution, backward, forward};
use crate::kernels::images::{Images, Pixels};
use crate::kernels::isa::{Element, Simd};
use crate::kernels::tasks::{parameters_len, prepare_layers, split_parameters_mut};

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
