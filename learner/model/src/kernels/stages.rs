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
    taken: Buffer<u8>,
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
        let (inputs, taken) = self.tape_lens();
        Tape {
            inputs: Buffer::new(images * inputs),
            taken: Buffer::new(images * taken),
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
        let (inputs, taken) = self.tape_lens();
        images
            .chunks_exact(self.image_len())
            .zip(tape.inputs.chunks_exact_mut(inputs))
            .zip(tape.taken.chunks_exact_mut(taken))
            .zip(f3.chunks_exact_mut(self.output_len()))
            .for_each(|(((image, inputs), taken), f3)| self.forward_one(image, inputs, taken, f3));
    }

    fn forward_one(
        &self,
        image: &[u8],
        mut inputs: &mut [S::Element],
        mut taken: &mut [u8],
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
            let (own, rest) = std::mem::take(&mut taken).split_at_mut(x.len());
            taken = rest;
            pool(simd, &maps, conv.shape().output(), &mut x, own);
            for block in blocks {
                let (one, two) = (&block[0], &block[1]);
                let outer = take_input(one, &mut inputs);
                one.shape().write_interior(simd, Interior::Relu(&x), outer);
                let inner = take_input(two, &mut inputs);
                two.shape().clear_border(inner);
                one.forward(simd, outer, |y, row| {
                    let to = &mut inner[two.shape().interior_row(y)];
                    store_relu_row(simd, row, one.bias(), 1.0, to);
                });
                two.forward(simd, inner, |y, row| {
                    let to = &mut x[y * row.len()..][..row.len()];
                    add_residual(simd, row, two.bias(), to);
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
        let ((inputs, taken), len) = (self.tape_lens(), self.output_len());
        images
            .chunks_exact(self.image_len())
            .zip(tape.inputs.chunks_exact(inputs))
            .zip(tape.taken.chunks_exact(taken))
            .zip(f3.chunks_exact(len).zip(grad_f3.chunks_exact(len)))
            .for_each(|(((image, inputs), taken), (f3, grad_f3))| {
                let mut grad = Buffer::new(len);
                relu_backward(self.simd, f3, grad_f3, &mut grad);
                let own_sums = split_parameters_mut(&shapes, &mut sums);
                self.backward_one(image, inputs, taken, grad, own_sums);
            });
        // Products with bytes are scaled only now.
        for sum in &mut sums[..shapes[0].weight_len()] {
            *sum *= S::Element::BYTE_SCALE;
        }
        sums
    }

    /// Adds one image's gradients to the `sums` of each convolution. `grad` is the gradient of the last stage's output.
    fn backward_one(
        &self,
        image: &[u8],
        mut inputs: &[S::Element],
        mut taken: &[u8],
        mut grad: Buffer<f32>,
        mut sums: Vec<[&mut [f32]; 2]>,
    ) {
        let simd = self.simd;
        let mut own_sums =
            |conv: &BorderedConvolution<S::Element>, input: &[S::Element], grad: &[f32]| {
                let own = sums.pop().expect("each convolution has sums");
                conv.parameter_gradients(simd, input, grad, own);
            };
        let stages = self.convolutions.chunks_exact(STAGE_CONVOLUTIONS);
        for (stage, convolutions) in stages.enumerate().rev() {
            let (conv, blocks) = (&convolutions[0], convolutions[1..].chunks_exact(2));
            for block in blocks.rev() {
                let (one, two) = (&block[0], &block[1]);
                let inner = take_last_input(two, &mut inputs);
                let outer = take_last_input(one, &mut inputs);
                own_sums(two, inner, &grad);
                let mut between = Buffer::<f32>::new(one.shape().map_len());
                two.image_gradient(simd, &grad, |y, row| {
                    let to = &mut between[y * row.len()..][..row.len()];
                    relu_backward(simd, &inner[two.shape().interior_row(y)], row, to);
                });
                own_sums(one, outer, &between);
                one.image_gradient(simd, &between, |y, row| {
                    let to = &mut grad[y * row.len()..][..row.len()];
                    add_relu_backward(simd, &outer[one.shape().interior_row(y)], row, to);
                });
            }
            let before;
            (taken, before) = split_tail(taken, grad.len());
            let mut grad_maps = Buffer::zeros(conv.shape().map_len());
            unpool(simd, &grad, conv.shape().output(), before, &mut grad_maps);
            if stage == 0 {
                let mut input = Buffer::new(conv.shape().bordered_len::<S::Element>());
                conv.shape()
                    .write_interior(simd, Interior::Bytes(image), &mut input);
                own_sums(conv, &input, &grad_maps);
                return;
            }
            own_sums(conv, take_last_input(conv, &mut inputs), &grad_maps);
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
