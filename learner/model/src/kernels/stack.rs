//! A stack of convolutions over one task's images, forward and backward, on slices.
//! It knows no tensors; `conv` splits the batch and `convolution` computes each layer.

use crate::geometry::ConvShape;
use crate::kernels::buffer::Buffer;
use crate::kernels::convolution::{Convolution, backward, forward};
use crate::kernels::images::{Images, Pixels};
use crate::kernels::isa::{Element, Simd};
use crate::kernels::tasks::{cut_mut, parameters_len, prepared};

/// The maps of each layer but the last: what forward leaves to backward.
pub(crate) type SavedActivations<E> = Vec<Buffer<E>>;

/// Convolutions with their parameters as the kernels want them.
pub(crate) struct Stack<S: Simd> {
    simd: S,
    layers: Vec<Convolution<S::Element>>,
}

impl<S: Simd> Stack<S> {
    /// At least one layer; `parameters` has for each its weight [out, in, k, k], then its bias [out]. `images` says whether the images of
    /// the first will need a gradient; all other layers' do in a backward pass, for which `backward` stands.
    pub(crate) fn new(
        simd: S,
        shapes: &[ConvShape],
        parameters: &[f32],
        backward: bool,
        images: bool,
    ) -> Self {
        let layers = prepared(shapes, parameters, |index, shape, [weight, bias]| {
            let backward = backward && (index > 0 || images);
            Convolution::new(simd, shape, weight, bias, backward)
        });
        Self { simd, layers }
    }

    pub(crate) fn image_len(&self) -> usize {
        self.layers[0].shape.image_len()
    }

    /// Runs `images` through the layers into `maps`, the last layer's output.
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

    /// Gradients for `grad_maps`, the gradient of the last layer's output `maps`; `saved` is from [`Stack::forward`].
    ///
    /// The result is the parameters' gradients, for each layer the weight's [k, k, in, out], then the bias's. The images' are
    /// added to `grad_images`, if it is there.
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
        // Of the layer at hand; the last layer's is not ours.
        let mut grad_output: Option<Buffer<f32>> = None;
        let layers = self.layers.iter().zip(cut_mut(&shapes, &mut sums));
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
                // Its output is f32.
                _ => backward(simd, layer, input, maps, grad_maps, sums, to),
            }
            grad_output = grad_input;
        }
        // Products with bytes that are scaled after them.
        let scale = Images::<S::Element>::Pixels(images).scale();
        if scale != 1.0 {
            for sum in &mut sums[..shapes[0].weight_len()] {
                *sum *= scale;
            }
        }
        sums
    }
}

/// What a layer takes: the maps of the one before it, or the images.
fn input_of<'a, E: Element>(images: Pixels<'a>, before: Option<&'a Buffer<E>>) -> Images<'a, E> {
    before.map_or(Images::Pixels(images), |maps| Images::Maps(maps))
}
