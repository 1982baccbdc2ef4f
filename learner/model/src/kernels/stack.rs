//! A stack of convolutions over one task's images, forward and backward, on slices.
//! It knows no tensors; `conv` splits the batch and `convolution` computes each layer.

use rayon::prelude::*;

use crate::geometry::ConvShape;
use crate::kernels::buffer::Buffer;
use crate::kernels::convolution::{ConvGradients, Convolution, backward, forward};
use crate::kernels::images::{Images, Pixels};
use crate::kernels::isa::Simd;

/// The maps of all layers but the last, one layer after the other: what forward leaves to backward.
pub(crate) type SavedActivations<E> = Buffer<E>;

/// Scalars of all layers' parameters.
pub(crate) fn parameters_len(shapes: &[ConvShape]) -> usize {
    shapes.iter().map(ConvShape::parameters_len).sum()
}

/// The layers of `parameters`: for each its weight [out, in, k, k], then its bias [out]. `images` says whether the images of the
/// first will need a gradient; all other layers' do in a backward pass, for which `backward` stands.
pub(crate) fn layers<S: Simd>(
    simd: S,
    shapes: &[ConvShape],
    mut parameters: &[f32],
    backward: bool,
    images: bool,
) -> Vec<Convolution<S::Element>> {
    let mut of_layers = Vec::with_capacity(shapes.len());
    for shape in shapes {
        let (own, rest) = parameters.split_at(shape.parameters_len());
        of_layers.push((shape, own));
        parameters = rest;
    }
    // On the pool, which all wait for.
    let layers = of_layers.into_par_iter().enumerate();
    let layers = layers.map(|(index, (&shape, own))| {
        let (weight, bias) = own.split_at(shape.weight_len());
        let backward = backward && (index > 0 || images);
        Convolution::new(simd, shape, weight, bias, backward)
    });
    layers.with_max_len(1).collect()
}

/// Gradients as `stack_backward` sums them, with the weights back as [out, in, k, k].
pub(crate) fn unpacked(shapes: &[ConvShape], sums: &[f32]) -> Vec<f32> {
    let mut result = vec![0.0; sums.len()];
    let (mut sums, mut free) = (sums, &mut result[..]);
    for shape in shapes {
        let (own, rest) = sums.split_at(shape.parameters_len());
        let (to, free_rest) = std::mem::take(&mut free).split_at_mut(own.len());
        let (packed, bias) = own.split_at(shape.weight_len());
        let (weight, bias_to) = to.split_at_mut(shape.weight_len());
        shape.unpack_weight(packed, weight);
        bias_to.copy_from_slice(bias);
        (sums, free) = (rest, free_rest);
    }
    result
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
    let saved_len = inner.iter().map(|layer| count * layer.shape.map_len());
    let mut saved = Buffer::new(saved_len.sum());
    let mut input = Images::Pixels(images);
    let mut free = &mut saved[..];
    for layer in inner {
        let len = count * layer.shape.map_len();
        let (output, rest) = std::mem::take(&mut free).split_at_mut(len);
        forward(simd, layer, input, output);
        (input, free) = (Images::Maps(output), rest);
    }
    forward(simd, last, input, maps);
    saved
}

/// Gradients for `grad_maps`, the gradient of the last layer's output `maps`; `saved` is from `stack_forward`.
///
/// The result is the parameters' gradients, for each layer the weight's [k, k, in, out], then the bias's. The images' are
/// added to `grad_images`, if it is there.
pub(crate) fn stack_backward<S: Simd>(
    simd: S,
    layers: &[Convolution<S::Element>],
    images: Pixels<'_>,
    saved: &SavedActivations<S::Element>,
    maps: &[f32],
    grad_maps: &[f32],
    mut grad_images: Option<&mut [f32]>,
) -> Buffer<f32> {
    let lens = layers.iter().map(|layer| layer.shape.parameters_len());
    let mut sums = Buffer::new(lens.sum());
    let Some((first, rest)) = layers.split_first() else {
        return sums;
    };
    let count = grad_maps.len() / layers[layers.len() - 1].shape.map_len();
    let (mut sums_left, mut saved) = (&mut sums[..], &saved[..]);
    // The output of the layer at hand, and its gradient; the last layer's are f32 and not ours.
    let mut output: Option<&[S::Element]> = None;
    let mut grad_output: Option<Buffer<f32>> = None;
    for layer in rest.iter().rev() {
        let shape = &layer.shape;
        let input_len = count * shape.image_len();
        let (earlier, input) = saved.split_at(saved.len() - input_len);
        saved = earlier;
        let mut grad_input = Buffer::zeros(input_len);
        let grads = ConvGradients::cut(&mut sums_left, shape, Some(&mut grad_input));
        let images = Images::Maps(input);
        match (output, &grad_output) {
            (Some(output), Some(grad)) => backward(simd, layer, images, output, grad, grads),
            _ => backward(simd, layer, images, maps, grad_maps, grads),
        }
        output = Some(input);
        grad_output = Some(grad_input);
    }
    let images = Images::Pixels(images);
    let scale = images.scale();
    let grads = ConvGradients::cut(&mut sums_left, &first.shape, grad_images.take());
    match (output, &grad_output) {
        (Some(output), Some(grad)) => backward(simd, first, images, output, grad, grads),
        _ => backward(simd, first, images, maps, grad_maps, grads),
    }
    // Products with bytes that are scaled after them.
    if scale != 1.0 {
        for sum in &mut sums[..first.shape.weight_len()] {
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
