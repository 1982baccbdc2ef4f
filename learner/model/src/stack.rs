//! A stack of convolutions over one task's images, forward and backward, on slices.
//! It knows neither tensors nor threads; `conv` splits the batch and `im2col` computes each layer.

use std::cell::RefCell;
use std::sync::{Mutex, PoisonError};

use crate::geometry::ConvShape;
use crate::im2col::{ConvGradients, ConvScratch, Images, backward, forward, grown};

/// Spare buffers kept for later passes; more are given back to the allocator.
const SPARE_MAX: usize = 64;

/// Buffers for maps between layers. Fresh memory for them would cost the forward pass a third of its time in page faults.
static SPARE: Mutex<Vec<Vec<f32>>> = Mutex::new(Vec::new());

thread_local! {
    static SCRATCH: RefCell<Scratch> = RefCell::default();
}

/// Buffers that a thread keeps between calls.
#[derive(Default)]
struct Scratch {
    conv: ConvScratch,
    grad_output: Vec<f32>,
    grad_input: Vec<f32>,
}

/// One convolution with its parameters as the kernels want them.
pub(crate) struct Layer<'a> {
    shape: ConvShape,
    /// [k, k, in, out]
    packed: Vec<f32>,
    /// [out]
    bias: &'a [f32],
}

/// The maps of all layers but the last, one layer after the other: what forward leaves to backward.
pub(crate) struct Between(Vec<f32>);

impl Between {
    fn new(len: usize) -> Self {
        let spare = SPARE.lock().unwrap_or_else(PoisonError::into_inner).pop();
        let mut maps = spare.unwrap_or_default();
        maps.resize(len, 0.0);
        Self(maps)
    }
}

impl Drop for Between {
    fn drop(&mut self) {
        let mut spare = SPARE.lock().unwrap_or_else(PoisonError::into_inner);
        if spare.len() < SPARE_MAX {
            spare.push(std::mem::take(&mut self.0));
        }
    }
}

/// Scalars of all layers' parameters.
pub(crate) fn parameters_len(shapes: &[ConvShape]) -> usize {
    shapes.iter().map(ConvShape::parameters_len).sum()
}

/// The layers of `parameters`: for each its weight [out, in, k, k], then its bias [out].
pub(crate) fn layers<'a>(shapes: &[ConvShape], mut parameters: &'a [f32]) -> Vec<Layer<'a>> {
    let mut layers = Vec::with_capacity(shapes.len());
    for &shape in shapes {
        let (weight, rest) = parameters.split_at(shape.weight_len());
        let (bias, rest) = rest.split_at(shape.channels_out);
        let packed = shape.pack_weight(weight);
        layers.push(Layer {
            shape,
            packed,
            bias,
        });
        parameters = rest;
    }
    layers
}

/// Gradients as `stack_backward` sums them, with the weights back as [out, in, k, k].
pub(crate) fn unpacked(shapes: &[ConvShape], mut sums: &[f32]) -> Vec<f32> {
    let mut result = Vec::with_capacity(sums.len());
    for shape in shapes {
        let (packed, rest) = sums.split_at(shape.weight_len());
        let (bias, rest) = rest.split_at(shape.channels_out);
        result.extend(shape.unpack_weight(packed));
        result.extend_from_slice(bias);
        sums = rest;
    }
    result
}

/// Runs `images` through the layers into `maps`, the last layer's output.
pub(crate) fn stack_forward(layers: &[Layer<'_>], images: Images<'_>, maps: &mut [f32]) -> Between {
    let Some((last, inner)) = layers.split_last() else {
        unreachable!("a stack has at least one layer")
    };
    let count = maps.len() / last.shape.map_len();
    let map_lens = inner.iter().map(|layer| count * layer.shape.map_len());
    let mut between = Between::new(map_lens.sum());
    let (mut input, mut free) = (images, &mut between.0[..]);
    with_scratch(|Scratch { conv, .. }| {
        for Layer {
            shape,
            packed,
            bias,
        } in inner
        {
            let (output, rest) = std::mem::take(&mut free).split_at_mut(count * shape.map_len());
            forward(shape, input, packed, bias, output, conv);
            (input, free) = (Images::Floats(output), rest);
        }
        forward(&last.shape, input, &last.packed, last.bias, maps, conv);
    });
    between
}

/// Gradients for `grad_maps`, the gradient of the last layer's output `maps`; `between` is from `stack_forward`.
///
/// The result is the parameters' gradients, for each layer the weight's [k, k, in, out], then the bias's. The images' are
/// added to `grad_images`, if it is there.
pub(crate) fn stack_backward(
    layers: &[Layer<'_>],
    images: Images<'_>,
    between: &Between,
    maps: &[f32],
    grad_maps: &[f32],
    mut grad_images: Option<&mut [f32]>,
) -> Vec<f32> {
    let mut sums = vec![
        0.0;
        layers
            .iter()
            .map(|layer| layer.shape.parameters_len())
            .sum()
    ];
    let (mut sums_left, mut between) = (&mut sums[..], &between.0[..]);
    with_scratch(|scratch| {
        let Scratch {
            conv,
            grad_output,
            grad_input,
        } = scratch;
        grown(grad_output, grad_maps.len()).copy_from_slice(grad_maps);
        let mut output = maps;
        for (index, Layer { shape, packed, .. }) in layers.iter().enumerate().rev() {
            let before = sums_left.len() - shape.parameters_len();
            let (left, sums) = std::mem::take(&mut sums_left).split_at_mut(before);
            sums_left = left;
            let (packed_sum, bias_sum) = sums.split_at_mut(shape.weight_len());
            let grad = &grad_output[..output.len()];

            if index == 0 {
                let images_sum = grad_images.take();
                let grads = ConvGradients {
                    packed: packed_sum,
                    bias: bias_sum,
                    images: images_sum,
                };
                backward(shape, images, packed, output, grad, grads, conv);
            } else {
                let input_len = output.len() / shape.map_len() * shape.image_len();
                let (earlier, input) = between.split_at(between.len() - input_len);
                between = earlier;
                let input_sum = grown(grad_input, input_len);
                input_sum.fill(0.0);
                let grads = ConvGradients {
                    packed: packed_sum,
                    bias: bias_sum,
                    images: Some(input_sum),
                };
                backward(
                    shape,
                    Images::Floats(input),
                    packed,
                    output,
                    grad,
                    grads,
                    conv,
                );
                output = input;
                std::mem::swap(grad_output, grad_input);
            }
        }
    });
    sums
}

/// Lends the thread's buffers to `work`, which must not start parallel work of its own.
fn with_scratch<R>(work: impl FnOnce(&mut Scratch) -> R) -> R {
    SCRATCH.with_borrow_mut(work)
}
