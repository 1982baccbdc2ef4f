//! Convolutions and the fully connected layer on their maps as one candle operation with gradients.
//! It runs on the CPU only.
//!
//! Where nothing but that layer reads the maps they are no tensor: candle would add their gradient to fresh zeros on a single thread,
//! and they are turned into the order of the layer's weight in the cache of the core that made them.

use std::sync::OnceLock;

use candle_core::{CpuStorage, CustomOp2, Layout, Result, Shape, Tensor, bail};

use crate::gradients::sum_in_place;
use crate::kernels::buffer::Buffer;
use crate::kernels::candle::ConvLayerTensors;
use crate::kernels::conv::{ConvStack, GradLayout, pixels, stack_of};
use crate::kernels::isa::{AnySimd, Mode, Simd, with_simd};
use crate::kernels::linear::{add_to, group_sums};
use crate::kernels::panels::Matrix;
use crate::kernels::precision::Precision;
use crate::kernels::product::{Biases, Product};
use crate::kernels::tensors::{cpu, floats, values_of};

/// [`linear_of_maps`](super::linear::linear_of_maps) of [`conv_stack`](super::conv::conv_stack), to the last bit: [B, outputs] of
/// `images` [B, H, W, C] u8.
///
/// Gradients of `weight` [outputs, inputs] and `bias` [outputs] are summed in place, so that a backward pass has to be one of
/// [`Backward::of`](crate::Backward::of).
pub(crate) fn torso(
    images: &Tensor,
    layers: &[ConvLayerTensors<'_>],
    weight: &Tensor,
    bias: &Tensor,
    precision: Precision,
) -> Result<Tensor> {
    let outputs = weight.dims2()?.0;
    let (shapes, parameters) = stack_of(images, layers)?;
    let images = images.contiguous()?;
    with_simd!(AnySimd::of(precision), simd => {
        let stack = ConvStack::new(simd, shapes);
        let inputs = stack.last().map_len();
        if weight.dims() != [outputs, inputs] || bias.dims() != [outputs] {
            bail!(
                "linear layer of {inputs} inputs with weight {:?} and bias {:?}",
                weight.shape(),
                bias.shape()
            );
        }
        let torso = Torso {
            stack,
            weight: weight.clone(),
            bias: bias.clone(),
            outputs,
            precision,
            kept: OnceLock::new(),
        };
        images.apply_op2(&parameters, torso)
    })
}

/// What the forward pass leaves to the backward pass: the maps, and the same flattened.
struct Kept {
    maps: Buffer<f32>,
    flat: Buffer<f32>,
}

struct Torso<S: Simd> {
    stack: ConvStack<S>,
    /// Of the fully connected layer.
    weight: Tensor,
    bias: Tensor,
    outputs: usize,
    precision: Precision,
    kept: OnceLock<Kept>,
}

impl<S: Simd> CustomOp2 for Torso<S> {
    fn name(&self) -> &'static str {
        "torso"
    }

    fn cpu_fwd(
        &self,
        images: &CpuStorage,
        images_layout: &Layout,
        parameters: &CpuStorage,
        parameters_layout: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        let stack = &self.stack;
        let images = pixels(images, images_layout)?;
        let (count, inputs) = (stack.count(images), stack.last().map_len());
        let (mut maps, mut flat) = (Buffer::new(count * inputs), Buffer::new(count * inputs));
        let parameters = floats(parameters, parameters_layout)?;
        stack.forward(images, parameters, &mut maps, &mut flat, &|maps, flat| {
            stack.flatten(maps, flat);
        });

        let (weight, bias) = (values_of(&self.weight)?, values_of(&self.bias)?);
        let biases = Biases {
            values: &bias,
            outputs: self.outputs,
            each: count,
        };
        let weight = Matrix::new(&weight, self.outputs, inputs);
        let x = Matrix::new(&flat, count, inputs);
        let y = Product::new(self.precision, x, weight.transposed())
            .added_to(biases)
            .to_vec();
        let first = self.kept.set(Kept { maps, flat }).is_ok();
        assert!(first, "an operation passes forward once");
        Ok((CpuStorage::F32(y), (count, self.outputs).into()))
    }

    fn bwd(
        &self,
        images: &Tensor,
        parameters: &Tensor,
        _y: &Tensor,
        grad_y: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>)> {
        let stack = &self.stack;
        let grad_y = grad_y.detach().contiguous()?;
        let grad_values = values_of(&grad_y)?;
        let (count, inputs) = (grad_y.dims2()?.0, stack.last().map_len());
        let grad = Matrix::new(&grad_values, count, self.outputs);
        let Kept { maps, flat } = self.kept.get().expect("a forward pass came before");
        let to_weight = Product::new(
            self.precision,
            grad.transposed(),
            Matrix::new(flat, count, inputs),
        );
        sum_in_place(&self.weight, |sum| to_weight.summed(sum))?;
        let to_bias = group_sums(&grad_values, 1, self.outputs);
        sum_in_place(&self.bias, |sum| add_to(sum, to_bias))?;

        let weight = values_of(&self.weight)?;
        let weight = Matrix::new(&weight, self.outputs, inputs);
        let mut grad_flat = Buffer::new(count * inputs);
        Product::new(self.precision, grad, weight).write(&mut grad_flat, Mode::Replace);
        let (images, images_layout) = images.storage_and_layout();
        let gradient = stack.backward(
            pixels(cpu(&images)?, images_layout)?,
            &values_of(parameters)?,
            maps,
            &grad_flat,
            GradLayout::Flat,
            &mut [],
        );
        let gradient = Tensor::from_vec(gradient, parameters.shape(), parameters.device())?;
        Ok((None, Some(gradient)))
    }
}
