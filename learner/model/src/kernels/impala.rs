//! The stages of an IMPALA torso as one candle operation with gradients. The batch is split over the rayon pool.
//! It runs on the CPU only. The layer after f3 is a separate operation. [`Stages`] passes one task's images through the stages, on slices;
//! `bordered` computes each convolution.

use candle_core::{Result, Tensor, bail};

use crate::geometry::{ConvShape, STAGE_CONVOLUTIONS, pooled_size, stage_shapes};
use crate::kernels::bordered::{BorderedConvolution, store_relu};
use crate::kernels::buffer::Buffer;
use crate::kernels::candle::BorderedTensors;
use crate::kernels::convolution::{relu_backward, store_relu_row};
use crate::kernels::images::Pixels;
use crate::kernels::isa::{AnySimd, Element, Simd, vectorized, with_simd};
use crate::kernels::linear::relu_gradient;
use crate::kernels::operation::{Operation, apply_op2};
use crate::kernels::pool::{pool, unpool};
use crate::kernels::precision::Precision;
use crate::kernels::rounding::{store, store_bytes};
use crate::kernels::tasks::{Tasks, parameters_len, prepare_layers, split_parameters_mut};
use crate::kernels::tensors::{Input, cpu_storage, values_of};

/// Images per task. The number is fixed, so that the order of additions does not depend on the number of threads.
const TASK_IMAGES: usize = 8;

/// Computes f3 [B, h, w, c] of `images` [B, H, W, C] u8, scaled by 1/255: stages of a convolution, a max pool
/// and two residual blocks x + conv(relu(conv(relu(x)))), then ReLU.
///
/// `layers` holds the weight [out, in, 3, 3] and the bias [out] of each convolution in the order of application. Convolutions
/// have zero padding. The pool is 3 x 3 with stride 2 and padding 1, which is never the largest. As in PyTorch, the first of
/// equal values in a window receives the gradient, and the gradient at a ReLU output of 0 is 0. Operands of products are
/// rounded to `precision`; residual sums are f32. The bits of results and gradients do not depend on the number of threads.
pub(crate) fn residual_stages(
    images: &Tensor,
    layers: &[BorderedTensors<'_>],
    precision: Precision,
) -> Result<Tensor> {
    let (count, height, width, channels) = images.dims4()?;
    let input = (height, width, channels);
    let widths = layers.chunks(STAGE_CONVOLUTIONS);
    let widths: Vec<usize> = widths.map(|it| it[0].1.elem_count()).collect();
    let fits = |((weight, bias), shape): (&BorderedTensors<'_>, &ConvShape)| {
        weight.dims() == [shape.channels_out, shape.channels_in, 3, 3]
            && bias.dims() == [shape.channels_out]
    };
    let (shapes, (rows, cols, width)) = stage_shapes(input, &widths);
    let is_whole = !layers.is_empty() && layers.len() == shapes.len() && images.elem_count() > 0;
    if !is_whole || !layers.iter().zip(&shapes).all(fits) {
        let weights: Vec<_> = layers.iter().map(|(weight, _)| weight.shape()).collect();
        bail!("stages on images {input:?} with weights {weights:?}");
    }
    let parameters = layers.iter().flat_map(|&(weight, bias)| [weight, bias]);
    let parameters: Result<Vec<_>> = parameters.map(Tensor::flatten_all).collect();
    let parameters = Tensor::cat(&parameters?, 0)?;
    with_simd!(AnySimd::fastest(precision), simd => {
        let operation = ResidualStages { simd, shapes, count };
        apply_op2(operation, [images, &parameters], (count, rows, cols, width))
    })
}

struct ResidualStages<S: Simd> {
    simd: S,
    shapes: Vec<ConvShape>,
    /// The number of images in the batch.
    count: usize,
}

impl<S: Simd> ResidualStages<S> {
    fn tasks(&self, stages: &Stages<S>) -> Tasks {
        Tasks {
            count: self.count,
            task_images: TASK_IMAGES,
            image_len: stages.image_len(),
            map_len: stages.output_len(),
        }
    }
}

fn bytes(images: Input<'_>) -> Result<&[u8]> {
    match images.pixels()? {
        Pixels::Bytes(bytes) => Ok(bytes),
        Pixels::Floats(_) => bail!("stages take images of bytes"),
    }
}

impl<S: Simd> Operation<2> for ResidualStages<S> {
    const NAME: &'static str = "residual-stages";

    /// The state of each task.
    type Saved = Vec<Tape<S::Element>>;

    fn forward(&self, [images, parameters]: [Input<'_>; 2]) -> Result<(Vec<f32>, Self::Saved)> {
        let images = bytes(images)?;
        let stages = Stages::new(self.simd, &self.shapes, parameters.floats()?, false);
        let mut f3 = vec![0.0; self.count * stages.output_len()];
        let saved = self.tasks(&stages).forward(&mut f3, |task, f3| {
            let mut tape = stages.allocate_tape(f3.len() / stages.output_len());
            stages.forward(&images[task], &mut tape, f3);
            tape
        });
        Ok((f3, saved))
    }

    fn backward(
        &self,
        [images, parameters]: [&Tensor; 2],
        saved: &Self::Saved,
        f3: &Tensor,
        grad_f3: &[f32],
    ) -> Result<[Option<Vec<f32>>; 2]> {
        let (storage, layout) = images.storage_and_layout();
        let images = bytes(Input::new(cpu_storage(&storage)?, layout))?;
        let f3 = values_of(f3)?;
        let stages = Stages::new(self.simd, &self.shapes, &values_of(parameters)?, true);
        let tasks = self.tasks(&stages);
        let gradient = tasks.backward(&self.shapes, saved, &mut [], |task, tape, _| {
            let (f3, grad_f3) = (&f3[task.maps.clone()], &grad_f3[task.maps]);
            stages.backward(&images[task.images], tape, f3, grad_f3)
        });
        Ok([None, Some(gradient)])
    }
}

/// All stages, their parameters packed for the kernels.
pub(crate) struct Stages<S: Simd> {
    simd: S,
    convolutions: Vec<BorderedConvolution<S::Element>>,
}

/// State that the forward pass of some images keeps for the backward pass.
pub(crate) struct Tape<E: Element> {
    /// For each image, the inputs of all convolutions but the first, with their borders. Each is the operand
    /// of a product. If a ReLU comes before it, it is above 0 exactly where a gradient passes that ReLU.
    inputs: Buffer<E>,
    /// For each image, the index of the pixel that each pool window took.
    argmax: Buffer<u8>,
}

const WHOLE_TAPE: &str = "a tape has a part for each convolution and each pool";

impl<S: Simd> Stages<S> {
    /// Prepares stages of convolutions with these shapes. `parameters` holds each one's weight
    /// [out, in, 3, 3], then its bias [out]. `backward` says whether a backward pass follows.
    pub(crate) fn new(simd: S, shapes: &[ConvShape], parameters: &[f32], backward: bool) -> Self {
        let convolutions = prepare_layers(shapes, parameters, |index, shape, [weight, bias]| {
            BorderedConvolution::new(simd, shape, weight, bias, backward && index > 0)
        });
        Self { simd, convolutions }
    }

    pub(crate) fn image_len(&self) -> usize {
        let first = self.convolutions[0].shape();
        (first.height - 2) * (first.width - 2) * first.channels_in
    }

    /// The number of scalars in f3 of one image.
    pub(crate) fn output_len(&self) -> usize {
        self.convolutions[self.convolutions.len() - 1]
            .shape()
            .map_len()
    }

    /// Allocates memory for what the forward pass of this many images keeps.
    pub(crate) fn allocate_tape(&self, images: usize) -> Tape<S::Element> {
        let (inputs, argmax) = self.tape_lens();
        Tape {
            inputs: Buffer::new(images * inputs),
            argmax: Buffer::new(images * argmax),
        }
    }

    /// The numbers of scalars per image in the two fields of [`Tape`].
    fn tape_lens(&self) -> (usize, usize) {
        let inputs = self.convolutions[1..].iter();
        let inputs = inputs.map(|it| it.shape().bordered_len::<S::Element>());
        let stages = self.convolutions.chunks_exact(STAGE_CONVOLUTIONS);
        let argmax = stages.map(|stage| pooled_len(&stage[0]));
        (inputs.sum(), argmax.sum())
    }

    /// Computes f3 of some images, one after the other.
    pub(crate) fn forward(&self, images: &[u8], tape: &mut Tape<S::Element>, f3: &mut [f32]) {
        let (inputs, argmax) = self.tape_lens();
        images
            .chunks_exact(self.image_len())
            .zip(tape.inputs.chunks_exact_mut(inputs))
            .zip(tape.argmax.chunks_exact_mut(argmax))
            .zip(f3.chunks_exact_mut(self.output_len()))
            .for_each(|(((image, inputs), argmax), f3)| {
                self.forward_image(image, inputs, argmax, f3);
            });
    }

    fn forward_image(
        &self,
        image: &[u8],
        mut inputs: &mut [S::Element],
        mut argmax: &mut [u8],
        f3: &mut [f32],
    ) {
        let simd = self.simd;
        let mut take_input = |conv: &BorderedConvolution<S::Element>| {
            let len = conv.shape().bordered_len::<S::Element>();
            inputs.split_off_mut(..len).expect(WHOLE_TAPE)
        };
        let mut first = Buffer::new(self.convolutions[0].shape().bordered_len::<S::Element>());
        let mut x = Buffer::<f32>::new(0);
        let stages = self.convolutions.chunks_exact(STAGE_CONVOLUTIONS);
        for (stage, convolutions) in stages.enumerate() {
            let (conv, blocks) = (&convolutions[0], convolutions[1..].chunks_exact(2));
            let (input, scale) = if stage == 0 {
                (&mut *first, S::Element::BYTE_SCALE)
            } else {
                (take_input(conv), 1.0)
            };
            conv.shape().write_interior(input, |from, to| match stage {
                0 => store_bytes(simd, &image[from], to),
                _ => store(simd, &x[from], to),
            });
            let mut maps = Buffer::new(conv.shape().map_len());
            conv.forward(simd, input, |y, row| {
                let to = &mut maps[y * row.len()..][..row.len()];
                add_bias(simd, row, scale, conv.bias(), to);
            });
            x = Buffer::new(pooled_len(conv));
            let own = argmax.split_off_mut(..x.len()).expect(WHOLE_TAPE);
            pool(simd, &maps, conv.shape().output(), &mut x, own);
            for block in blocks {
                let (conv1, conv2) = (&block[0], &block[1]);
                let x1 = take_input(conv1);
                conv1
                    .shape()
                    .write_interior(x1, |from, to| store_relu(simd, &x[from], to));
                let x2 = take_input(conv2);
                conv2.shape().clear_border(x2);
                conv1.forward(simd, x1, |y, row| {
                    let to = &mut x2[conv2.shape().interior_row(y)];
                    store_relu_row(simd, row, conv1.bias(), 1.0, to);
                });
                conv2.forward(simd, x2, |y, row| {
                    let to = &mut x[y * row.len()..][..row.len()];
                    add_residual(simd, row, conv2.bias(), to);
                });
            }
        }
        store_relu(simd, &x, f3);
    }

    /// Computes the gradients of all parameters for `grad_f3`. `tape` and `f3` are from the forward pass of
    /// `images`. Returns for each convolution the weight's gradient [3, 3, in, out], then the bias's.
    pub(crate) fn backward(
        &self,
        images: &[u8],
        tape: &Tape<S::Element>,
        f3: &[f32],
        grad_f3: &[f32],
    ) -> Buffer<f32> {
        let shapes: Vec<_> = self.convolutions.iter().map(|it| *it.shape()).collect();
        let mut sums = Buffer::zeros(parameters_len(&shapes));
        let ((inputs, argmax), len) = (self.tape_lens(), self.output_len());
        images
            .chunks_exact(self.image_len())
            .zip(tape.inputs.chunks_exact(inputs))
            .zip(tape.argmax.chunks_exact(argmax))
            .zip(f3.chunks_exact(len).zip(grad_f3.chunks_exact(len)))
            .for_each(|(((image, inputs), argmax), (f3, grad_f3))| {
                let mut grad = Buffer::new(len);
                relu_backward(self.simd, f3, grad_f3, &mut grad);
                let layer_sums = split_parameters_mut(&shapes, &mut sums);
                self.backward_image(image, inputs, argmax, grad, layer_sums);
            });
        // Products with bytes are scaled only now.
        for sum in &mut sums[..shapes[0].weight_len()] {
            *sum *= S::Element::BYTE_SCALE;
        }
        sums
    }

    /// Adds one image's gradients to the `sums` of each convolution. `grad` is the gradient of the last stage's output.
    fn backward_image(
        &self,
        image: &[u8],
        mut inputs: &[S::Element],
        mut argmax: &[u8],
        mut grad: Buffer<f32>,
        mut sums: Vec<[&mut [f32]; 2]>,
    ) {
        let simd = self.simd;
        let mut add_gradients =
            |conv: &BorderedConvolution<S::Element>, input: &[S::Element], grad: &[f32]| {
                let own = sums.pop().expect("each convolution has sums");
                conv.parameter_gradients(simd, input, grad, own);
            };
        let mut take_input = |conv: &BorderedConvolution<S::Element>| {
            let first = inputs.len() - conv.shape().bordered_len::<S::Element>();
            inputs.split_off(first..).expect(WHOLE_TAPE)
        };
        let stages = self.convolutions.chunks_exact(STAGE_CONVOLUTIONS);
        for (stage, convolutions) in stages.enumerate().rev() {
            let (conv, blocks) = (&convolutions[0], convolutions[1..].chunks_exact(2));
            for block in blocks.rev() {
                let (conv1, conv2) = (&block[0], &block[1]);
                let x2 = take_input(conv2);
                let x1 = take_input(conv1);
                add_gradients(conv2, x2, &grad);
                let mut grad_x2 = Buffer::<f32>::new(conv1.shape().map_len());
                conv2.image_gradient(simd, &grad, |y, row| {
                    let to = &mut grad_x2[y * row.len()..][..row.len()];
                    relu_backward(simd, &x2[conv2.shape().interior_row(y)], row, to);
                });
                add_gradients(conv1, x1, &grad_x2);
                conv1.image_gradient(simd, &grad_x2, |y, row| {
                    let to = &mut grad[y * row.len()..][..row.len()];
                    add_relu_backward(simd, &x1[conv1.shape().interior_row(y)], row, to);
                });
            }
            let first = argmax.len() - grad.len();
            let own = argmax.split_off(first..).expect(WHOLE_TAPE);
            let mut grad_maps = Buffer::zeros(conv.shape().map_len());
            unpool(simd, &grad, conv.shape().output(), own, &mut grad_maps);
            if stage == 0 {
                let len = conv.shape().bordered_len::<S::Element>();
                let mut input = Buffer::<S::Element>::new(len);
                conv.shape().write_interior(&mut input, |from, to| {
                    store_bytes(simd, &image[from], to);
                });
                add_gradients(conv, &input, &grad_maps);
                return;
            }
            add_gradients(conv, take_input(conv), &grad_maps);
            grad = Buffer::new(conv.shape().locations() * conv.shape().channels_in);
            conv.image_gradient(simd, &grad_maps, |y, row| {
                grad[y * row.len()..][..row.len()].copy_from_slice(row);
            });
        }
    }
}

/// The number of scalars in the output of the pool after `conv`.
fn pooled_len<E: Element>(conv: &BorderedConvolution<E>) -> usize {
    let (height, width, channels) = pooled_size(conv.shape().output());
    height * width * channels
}

vectorized! {
    fn add_bias<S>(simd, row: &'a [f32], scale: f32, bias: &'a [f32], to: &'a mut [f32]) {
        for ((to, &value), &bias) in to.iter_mut().zip(row).zip(bias) {
            *to = value * scale + bias;
        }
    }

    fn add_residual<S>(simd, row: &'a [f32], bias: &'a [f32], to: &'a mut [f32]) {
        for ((to, &value), &bias) in to.iter_mut().zip(row).zip(bias) {
            *to += value + bias;
        }
    }

    /// Adds to `to` the gradients before a ReLU whose output was `active`.
    fn add_relu_backward<S>(simd, active: &'a [S::Element], grads: &'a [f32], to: &'a mut [f32]) {
        for ((to, &active), &grad) in to.iter_mut().zip(active).zip(grads) {
            *to += relu_gradient(active.value(), grad);
        }
    }
}
