//! The stages of an IMPALA torso over one task's images, forward and backward, on slices: a convolution, a max pool, and two residual
//! blocks x + conv(relu(conv(relu(x)))) each. It knows no tensors: `impala` splits the batch, `bordered` computes each convolution.

use crate::geometry::{ConvShape, STAGE_CONVOLUTIONS, pooled_size};
use crate::kernels::bordered::{BorderedConvolution, Interior, store_relu};
use crate::kernels::buffer::Buffer;
use crate::kernels::convolution::{relu_backward, store_relu_row};
use crate::kernels::isa::{Element, Simd, vectorized};
use crate::kernels::linear::relu_gradient;
use crate::kernels::pool::{pool, unpool};
use crate::kernels::tasks::{parameters_len, prepare_layers, split_parameters_mut};

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
        (
            inputs.sum(),
            stages.map(|stage| pooled_len(&stage[0])).sum(),
        )
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
        let mut first = Buffer::new(self.convolutions[0].shape().bordered_len::<S::Element>());
        let mut x = Buffer::new(0);
        let stages = self.convolutions.chunks_exact(STAGE_CONVOLUTIONS);
        for (stage, convolutions) in stages.enumerate() {
            let (conv, blocks) = (&convolutions[0], convolutions[1..].chunks_exact(2));
            let (input, content, scale) = if stage == 0 {
                (&mut *first, Interior::Bytes(image), S::Element::BYTE_SCALE)
            } else {
                (take_input(conv, &mut inputs), Interior::Maps(&x), 1.0)
            };
            conv.shape().write_interior(simd, content, input);
            let mut maps = Buffer::new(conv.shape().map_len());
            conv.forward(simd, input, |y, row| {
                let to = &mut maps[y * row.len()..][..row.len()];
                add_bias(simd, row, scale, conv.bias(), to);
            });
            x = Buffer::new(pooled_len(conv));
            let (own, rest) = std::mem::take(&mut argmax).split_at_mut(x.len());
            argmax = rest;
            pool(simd, &maps, conv.shape().output(), &mut x, own);
            for block in blocks {
                let (conv1, conv2) = (&block[0], &block[1]);
                let x1 = take_input(conv1, &mut inputs);
                conv1.shape().write_interior(simd, Interior::Relu(&x), x1);
                let x2 = take_input(conv2, &mut inputs);
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
        let stages = self.convolutions.chunks_exact(STAGE_CONVOLUTIONS);
        for (stage, convolutions) in stages.enumerate().rev() {
            let (conv, blocks) = (&convolutions[0], convolutions[1..].chunks_exact(2));
            for block in blocks.rev() {
                let (conv1, conv2) = (&block[0], &block[1]);
                let x2 = take_last_input(conv2, &mut inputs);
                let x1 = take_last_input(conv1, &mut inputs);
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
            let own;
            (argmax, own) = split_tail(argmax, grad.len());
            let mut grad_maps = Buffer::zeros(conv.shape().map_len());
            unpool(simd, &grad, conv.shape().output(), own, &mut grad_maps);
            if stage == 0 {
                let mut input = Buffer::new(conv.shape().bordered_len::<S::Element>());
                conv.shape()
                    .write_interior(simd, Interior::Bytes(image), &mut input);
                add_gradients(conv, &input, &grad_maps);
                return;
            }
            add_gradients(conv, take_last_input(conv, &mut inputs), &grad_maps);
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

/// Takes the memory for the input of `conv` off the start of `inputs`.
fn take_input<'a, E: Element>(
    conv: &BorderedConvolution<E>,
    inputs: &mut &'a mut [E],
) -> &'a mut [E] {
    let (own, rest) = std::mem::take(inputs).split_at_mut(conv.shape().bordered_len::<E>());
    *inputs = rest;
    own
}

/// Takes the input of `of` off the end of `inputs`.
fn take_last_input<'a, E: Element>(of: &BorderedConvolution<E>, inputs: &mut &'a [E]) -> &'a [E] {
    let own;
    (*inputs, own) = split_tail(inputs, of.shape().bordered_len::<E>());
    own
}

/// Splits `values` into all but the last `len`, and the last `len`.
fn split_tail<T>(values: &[T], len: usize) -> (&[T], &[T]) {
    values.split_at(values.len() - len)
}

vectorized! {
    fn add_bias<S>(simd, row: &'a [f32], scale: f32, bias: &'a [f32], to: &'a mut [f32]) {
        for ((to, &value), &bias) in to.iter_mut().zip(row).zip(bias) {
            *to = value * scale + bias;
        }
    }
}

vectorized! {
    fn add_residual<S>(simd, row: &'a [f32], bias: &'a [f32], to: &'a mut [f32]) {
        for ((to, &value), &bias) in to.iter_mut().zip(row).zip(bias) {
            *to += value + bias;
        }
    }
}

vectorized! {
    /// Adds to `to` the gradients before a ReLU whose output was `active`.
    fn add_relu_backward<S>(simd, active: &'a [S::Element], grads: &'a [f32], to: &'a mut [f32]) {
        for ((to, &active), &grad) in to.iter_mut().zip(active).zip(grads) {
            *to += relu_gradient(active.value(), grad);
        }
    }
}
