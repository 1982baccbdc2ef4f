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

/// The layers of `parameters`: for each its weight [out, in, k, k], then its bias [out]. `images` says whether the images of the
/// first will need a gradient; all other layers' do in a backward pass, for which `backward` stands.
pub(crate) fn layers<S: Simd>(
    simd: S,
    shapes: &[ConvShape],
    parameters: &[f32],
    backward: bool,
    images: bool,
) -> Vec<Convolution<S::Element>> {
    prepared(shapes, parameters, |index, shape, [weight, bias]| {
        let backward = backward && (index > 0 || images);
        Convolution::new(simd, shape, weight, bias, backward)
    })
}

/// Runs `images` through the layers into `maps`, the last layer's output.
pub(crate) fn stack_forward<S: Simd>(
    simd: S,
    layers: &[Convolution<S::Element>],
    images: Pixels<'_>,
    maps: &mut [f32],
) -> SavedActivations<S::Element> {
    let Some((last, inner)) = layers.split_last() else {
        unreachable!("a stack has at least one layer")
    };
    let count = maps.len() / last.shape.map_len();
    let mut saved = SavedActivations::with_capacity(inner.len());
    for layer in inner {
        let mut output = Buffer::new(count * layer.shape.map_len());
        forward(simd, layer, input_of(images, saved.last()), &mut output);
        saved.push(output);
    }
    forward(simd, last, input_of(images, saved.last()), maps);
    saved
}

/// What a layer takes: the maps of the one before it, or the images.
fn input_of<'a, E: Element>(images: Pixels<'a>, before: Option<&'a Buffer<E>>) -> Images<'a, E> {
    before.map_or(Images::Pixels(images), |maps| Images::Maps(maps))
}

/// Gradients for `grad_maps`, the gradient of the last layer's output `maps`; `saved` is from `stack_forward`.
///
/// The result is the parameters' gradients, for each layer the weight's [k, k, in, out], then the bias's. The images' are
/// added to `grad_images`, if it is there.
pub(crate) fn stack_backward<S: Simd>(
    simd: S,
    layers: &[Convolution<S::Element>],
    images: Pixels<'_>,
    saved: &[Buffer<S::Element>],
    maps: &[f32],
    grad_maps: &[f32],
    mut grad_images: Option<&mut [f32]>,
) -> Buffer<f32> {
    let shapes: Vec<_> = layers.iter().map(|layer| layer.shape).collect();
    let mut sums = Buffer::new(parameters_len(&shapes));
    // Of the layer at hand; the last layer's is not ours.
    let mut grad_output: Option<Buffer<f32>> = None;
    let parameters = layers.iter().zip(cut_mut(&shapes, &mut sums));
    for (index, (layer, sums)) in parameters.enumerate().rev() {
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::ConvLayer;
    use crate::kernels::isa::{AnySimd, with_simd};
    use crate::kernels::precision::Precision;

    /// Sizes that fill no register: odd runs, odd numbers of windows, channels beyond a panel.
    fn shapes() -> Vec<ConvShape> {
        let layers = [(5, 3, 2), (70, 4, 1), (9, 2, 1)];
        let mut input = (17, 23, 3);
        let shape = |(out, kernel, stride)| {
            let layer = ConvLayer::new(out, kernel, stride);
            let shape = ConvShape::new(input, layer).unwrap();
            input = shape.output();
            shape
        };
        layers.map(shape).to_vec()
    }

    fn values(len: usize, by: usize, scale: f32) -> Vec<f32> {
        (0..len)
            .map(|at| ((at * by % 101) as f32 / 50.0 - 1.0) * scale)
            .collect()
    }

    /// Maps, gradients of parameters and of images.
    fn passed<S: Simd>(
        simd: S,
        shapes: &[ConvShape],
        parameters: &[f32],
        images: Pixels<'_>,
        grad_maps: &[f32],
    ) -> [Vec<f32>; 3] {
        let layers = layers(simd, shapes, parameters, true, true);
        let mut maps = vec![0.0; grad_maps.len()];
        let saved = stack_forward(simd, &layers, images, &mut maps);
        let mut grad_images = vec![0.0; images.len()];
        let to = Some(&mut grad_images[..]);
        let grads = stack_backward(simd, &layers, images, &saved, &maps, grad_maps, to);
        [maps, grads.to_vec(), grad_images]
    }

    #[test]
    fn every_instruction_set_gives_the_same_up_to_the_order_of_sums() {
        let shapes = shapes();
        let (first, last) = (&shapes[0], &shapes[2]);
        let count = 3;
        let floats = values(count * first.image_len(), 37, 1.0);
        let bytes: Vec<u8> = (0..floats.len()).map(|at| (at * 31 % 256) as u8).collect();
        let parameters = values(parameters_len(&shapes), 53, 0.2);
        let grad_maps = values(count * last.map_len(), 17, 1.0);
        for images in [Pixels::Floats(&floats), Pixels::Bytes(&bytes)] {
            for precision in Precision::ALL {
                let of_simd = |simd| with_simd!(simd, simd => passed(simd, &shapes, &parameters, images, &grad_maps));
                let results: Vec<_> = AnySimd::every(precision).into_iter().map(of_simd).collect();
                let (wanted, others) = results.split_first().unwrap();
                // A sum that lands on the other side of a bf16 moves what is computed from it by its 256th part.
                let tolerance = match precision {
                    Precision::F32 => 1e-5,
                    Precision::Bf16 => 1e-2,
                };
                for result in others {
                    for (got, wanted) in result.iter().zip(wanted) {
                        let norm = |values: &mut dyn Iterator<Item = f32>| {
                            values
                                .map(|x| f64::from(x) * f64::from(x))
                                .sum::<f64>()
                                .sqrt()
                        };
                        let error = norm(&mut got.iter().zip(wanted).map(|(a, b)| a - b));
                        let size = norm(&mut wanted.iter().copied());
                        assert!(
                            size > 0.0 && error <= tolerance * size,
                            "{precision}: {error} of {size}"
                        );
                    }
                }
            }
        }
    }
}
