//! Convolutions and the fully connected layer on their maps as one candle operation with gradients.
//! It runs on the CPU only.
//!
//! If only that layer reads the maps, they need not be a tensor, whose gradient candle would add to fresh zeros on a
//! single thread. Here the core that computes the maps transposes them in its cache to the order of the layer's weight.

use candle_core::{Result, Tensor, bail};

use crate::gradients::accumulate_in_place;
use crate::kernels::buffer::Buffer;
use crate::kernels::candle::ConvLayerTensors;
use crate::kernels::conv::{ConvStack, SavedActivations, flatten_layers};
use crate::kernels::isa::{AnySimd, Element, Mode, Simd, with_simd};
use crate::kernels::linear::{add_to_sum, group_sums, transpose_images};
use crate::kernels::operation::{Operation, apply_op2};
use crate::kernels::panels::Matrix;
use crate::kernels::precision::Precision;
use crate::kernels::product::Product;
use crate::kernels::tensors::{Input, cpu_storage, values_of};

/// Computes [B, outputs] of `images` [B, H, W, C] u8: bit for bit
/// [`linear_of_maps`](super::linear::linear_of_maps) of [`conv_stack`](super::conv::conv_stack).
///
/// Gradients of `weight` [outputs, inputs] and `bias` [outputs] are summed in place, so only
/// [`backward`](crate::backward) can run the backward pass.
pub(crate) fn torso(
    images: &Tensor,
    layers: &[ConvLayerTensors<'_>],
    weight: &Tensor,
    bias: &Tensor,
    precision: Precision,
) -> Result<Tensor> {
    let (shapes, parameters) = flatten_layers(images, layers)?;
    let (count, outputs) = (images.dim(0)?, weight.dims2()?.0);
    let inputs = shapes[shapes.len() - 1].map_len();
    if weight.dims() != [outputs, inputs] || bias.dims() != [outputs] {
        let (weight, bias) = (weight.shape(), bias.shape());
        bail!("linear layer of {inputs} inputs with weight {weight:?} and bias {bias:?}");
    }
    with_simd!(AnySimd::fastest(precision), simd => {
        let torso = Torso {
            stack: ConvStack { simd, shapes, count },
            weight: weight.clone(),
            bias: bias.clone(),
            inputs,
            outputs,
            precision,
        };
        apply_op2(torso, [images, &parameters], (count, outputs))
    })
}

struct Torso<S: Simd> {
    stack: ConvStack<S>,
    /// Weight of the fully connected layer, whose bias is `bias`.
    weight: Tensor,
    bias: Tensor,
    inputs: usize,
    outputs: usize,
    precision: Precision,
}

/// State that the forward pass keeps for the backward pass.
struct SavedState<E: Element> {
    /// For each task, the maps of all layers but the last, and those of the last.
    tasks: Vec<(SavedActivations<E>, Buffer<f32>)>,
    /// The last layer's maps, flattened.
    flat: Buffer<f32>,
}

impl<S: Simd> Operation<2> for Torso<S> {
    const NAME: &'static str = "torso";

    type Saved = SavedState<S::Element>;

    fn forward(&self, [images, parameters]: [Input<'_>; 2]) -> Result<(Vec<f32>, Self::Saved)> {
        let (stack, images) = (&self.stack, images.pixels()?);
        let layers = stack.prepare(parameters.floats()?, false, false);
        let last = stack.last_shape();
        let mut flat = Buffer::<f32>::new(stack.count * self.inputs);
        let tasks = stack.tasks().forward(&mut flat, |task, flat| {
            let mut maps = Buffer::<f32>::new(flat.len());
            let saved = layers.forward(images.slice(task), &mut maps);
            transpose_images(&maps, last.locations(), last.channels_out, flat);
            (saved, maps)
        });

        let (weight, bias) = (values_of(&self.weight)?, values_of(&self.bias)?);
        let weight = Matrix::new(&weight, self.outputs, self.inputs);
        let x = Matrix::new(&flat, stack.count, self.inputs);
        let product = Product::new(self.precision, x, weight.transposed());
        let y = product.with_biases(&bias).to_vec();
        Ok((y, SavedState { tasks, flat }))
    }

    fn backward(
        &self,
        [images, parameters]: [&Tensor; 2],
        saved: &Self::Saved,
        _y: &Tensor,
        grad_y: &[f32],
    ) -> Result<[Option<Vec<f32>>; 2]> {
        let stack = &self.stack;
        let grad = Matrix::new(grad_y, stack.count, self.outputs);
        let x = Matrix::new(&saved.flat, stack.count, self.inputs);
        let weight_gradient = Product::new(self.precision, grad.transposed(), x);
        accumulate_in_place(&self.weight, |sum| weight_gradient.added_to_sum(sum))?;
        let bias_gradient = group_sums(grad_y, 1, self.outputs);
        accumulate_in_place(&self.bias, |sum| add_to_sum(sum, bias_gradient))?;

        let weight = values_of(&self.weight)?;
        let weight = Matrix::new(&weight, self.outputs, self.inputs);
        let mut grad_flat = Buffer::<f32>::new(stack.count * self.inputs);
        Product::new(self.precision, grad, weight).write(&mut grad_flat, Mode::Replace);
        let (storage, layout) = images.storage_and_layout();
        let images = Input::new(cpu_storage(&storage)?, layout).pixels()?;
        let layers = stack.prepare(&values_of(parameters)?, true, false);
        let (tasks, last) = (stack.tasks(), stack.last_shape());
        let gradient = tasks.backward(&stack.shapes, &saved.tasks, &mut [], |task, saved, _| {
            let ((saved, maps), flat) = (saved, &grad_flat[task.maps]);
            let mut grad_maps = Buffer::<f32>::new(flat.len());
            transpose_images(flat, last.channels_out, last.locations(), &mut grad_maps);
            let images = images.slice(task.images);
            layers.backward(images, saved, maps, &grad_maps, None)
        });
        Ok([None, Some(gradient)])
    }
}
