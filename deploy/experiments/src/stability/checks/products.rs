//! Products of the network in f32 and bf16, results and gradients, compared with candle's in f64.
//! The kernels are in the model crate, which tests their parts against candle's kernels.

use candle_core::{DType, Device, Tensor, Var};
use driml_model::{Precision, conv_stack, linear, relu};

use crate::stability::property::*;

const PRODUCT: &str = "a sum of products, as a share of the precision's `product_error` and floor";
const HIDDEN: &str = "cases that hide it, or change other rows or later calls";
const SIZES: &str = "fully connected, results and gradients: operands of 0, 1e-45, 1e-40, 1e-38, 1e-20, 1, 1e17, one among others";
const DRAWN: &str = "fully connected, results and gradients, drawn";
const MAPS: &str = "convolution with ReLU, results and gradients, on floats and bytes, drawn";
const PROCGEN: &str = "both at the sizes of Procgen's network, 32 images, and of DIM's heads";
const SPOILT: &str = "one operand infinite or not a number, before and after ReLU";
const BEYOND: &str = "products beyond 3.4e38, all of one sign";

pub(super) fn properties() -> Vec<Property> {
    let finite = "operands finite, the sum of their products' sizes below 3.4e38";
    let in_bf16 = "operands within 3.38e38, the sum of their products' sizes below 3.3e38";
    let property = |routine, range, precision| {
        Property::new(routine, range)
            .promise(PRODUCT, 1.0)
            .promise(HIDDEN, 0.0)
            .check(SIZES, Listed, move |it| dense_by_size(it, precision))
            .check(DRAWN, Drawn(0.02), move |it| dense(it, precision))
            .check(MAPS, Drawn(0.02), move |it| convolution(it, precision))
            .check(PROCGEN, Listed, move |it| procgen_layers(it, precision))
            .check(SPOILT, Drawn(0.02), move |it| spoilt(it, precision))
            .check(BEYOND, Drawn(0.01), move |it| infinite(it, precision))
    };
    vec![
        property("products, f32", finite, Precision::F32),
        property("products, bf16", in_bf16, Precision::Bf16),
    ]
}

/// The layers of Procgen's network and of DIM's heads.
const LAYERS: [Layer; 6] = [
    // From the feature maps to the hidden layer, from there to the atoms of 15 actions, and from each map location to a DIM embedding.
    Layer::new([256, 1024, 512], [0; 3]),
    Layer::new([256, 512, 765], [0; 3]),
    Layer::new([4096, 64, 512], [0; 3]),
    // Convolutions, without the border that the first does not read.
    Layer::new([32, 3, 32], [60, 8, 4]),
    Layer::new([32, 32, 64], [14, 4, 2]),
    Layer::new([32, 64, 64], [6, 3, 1]),
];

/// A fully connected layer if `kernel` is 0, else a convolution with ReLU of images [B, side, side, inputs].
#[derive(Clone, Copy, Debug)]
struct Layer {
    rows: usize,
    inputs: usize,
    outputs: usize,
    side: usize,
    kernel: usize,
    stride: usize,
}

/// Inputs, weights, biases, and the gradient with respect to the results.
type Operands = [Tensor; 4];

type Draw<'a> = &'a mut dyn FnMut(usize, &mut ChaCha8Rng) -> Vec<f32>;

impl Layer {
    const fn new([rows, inputs, outputs]: [usize; 3], [side, kernel, stride]: [usize; 3]) -> Self {
        Self {
            rows,
            inputs,
            outputs,
            side,
            kernel,
            stride,
        }
    }

    fn draw_dense(rng: &mut ChaCha8Rng) -> Self {
        Self::new([40, 200, 40].map(|most| rng.random_range(1..most)), [0; 3])
    }

    const fn is_convolution(&self) -> bool {
        self.kernel > 0
    }

    fn operands(&self, draw: Draw<'_>, rng: &mut ChaCha8Rng) -> anyhow::Result<Operands> {
        let square = |side| vec![side; if self.is_convolution() { 2 } else { 0 }];
        let places = (self.side - self.kernel).checked_div(self.stride);
        let places = places.map_or(0, |steps| steps + 1);
        let mut tensor = |shape: Vec<usize>| {
            Tensor::from_vec(draw(shape.iter().product(), rng), shape, &Device::Cpu)
        };
        Ok([
            tensor([vec![self.rows], square(self.side), vec![self.inputs]].concat())?,
            tensor([vec![self.outputs, self.inputs], square(self.kernel)].concat())?,
            tensor(vec![self.outputs])?,
            tensor([vec![self.rows], square(places), vec![self.outputs]].concat())?,
        ])
    }

    /// Computes the layer in f64 with candle's operations, before ReLU.
    fn exact(&self, [x, w, b]: &[Var; 3]) -> candle_core::Result<Tensor> {
        let y = match self.is_convolution() {
            false => x.matmul(&w.t()?)?,
            true => {
                let images = x.permute((0, 3, 1, 2))?.contiguous()?;
                let maps = images.conv2d(w, 0, self.stride, 1, 1)?;
                maps.permute((0, 2, 3, 1))?.contiguous()?
            }
        };
        y.broadcast_add(b)
    }

    /// Returns the worst error of results and gradients, as a share of the promised bound.
    fn error(&self, operands: &Operands, precision: Precision) -> anyhow::Result<f64> {
        let found = backprop(operands, |[x, w, b]| match self.is_convolution() {
            false => linear(x, w, b, precision),
            true => conv_stack(x, &[(w.as_tensor(), b.as_tensor(), self.stride)], precision),
        })?;
        let has_bytes = operands[0].dtype() == DType::U8;
        let mut exact = operands.clone();
        for tensor in &mut exact {
            *tensor = tensor.to_dtype(DType::F64)?;
        }
        if has_bytes {
            exact[0] = (&exact[0] * (1.0 / 255.0))?;
        }
        if self.is_convolution() {
            // ReLU passes no gradient where the result is 0.
            let y = Tensor::from_slice(&found[0], exact[3].shape(), &Device::Cpu)?;
            exact[3] = (&exact[3] * y.gt(0.0)?.to_dtype(DType::F64)?)?;
        }
        let backprop = |operands: &Operands| backprop(operands, |vars| self.exact(vars));
        let [mut sizes, mut ones, mut sums] = [(); 3].map(|()| exact.clone());
        for (at, tensor) in exact.iter().enumerate() {
            sizes[at] = tensor.abs()?;
            ones[at] = tensor.ones_like()?;
            sums[at] = (&sizes[at] + &ones[at])?;
        }
        // Biases are not part of a product.
        (ones[2], sums[2]) = (exact[2].zeros_like()?, sizes[2].clone());
        let [exact, sizes] = [backprop(&exact)?, backprop(&sizes)?];
        let [terms, sums] = [backprop(&ones)?, backprop(&sums)?];
        let mut errors = Vec::new();
        for part in 0..4 {
            // The gradient of a bias is a sum without products, computed in f32 in either precision.
            let precision = if part == 3 { Precision::F32 } else { precision };
            // A byte / 255 is rounded twice.
            let roundings = if has_bytes && part != 3 { 2.0 } else { 0.0 };
            for (at, &found) in found[part].iter().enumerate() {
                let (mut exact, size, terms) = (exact[part][at], sizes[part][at], terms[part][at]);
                if part == 0 && self.is_convolution() {
                    exact = exact.max(0.0);
                }
                let error = (found - exact).abs();
                // Near the largest f32 nothing is promised, because rounding to bf16 may enlarge a sum by a 128th.
                if error == 0.0 || size * 1.01 >= f64::from(f32::MAX) {
                    continue;
                }
                // The promise holds for the largest operand. The mean is stricter, and follows from (1 + a) (1 + b) = 1 + a + b + a b.
                let mean = (sums[part][at] - size - terms) / (2.0 * terms);
                let terms = (terms + roundings) as usize;
                let allowed = precision.product_error(terms) * size;
                errors.push(error / (allowed + precision.product_floor(terms, mean)));
            }
        }
        Ok(max_error(errors))
    }

    /// Counts the errors on drawn operands, and for a convolution also on inputs of bytes.
    fn record_errors(
        &self,
        cases: &mut Cases<'_>,
        precision: Precision,
        draw: Draw<'_>,
    ) -> anyhow::Result<()> {
        let mut operands = self.operands(draw, &mut cases.rng)?;
        loop {
            let error = self.error(&operands, precision)?;
            let [x, w, ..] = &operands;
            let w = w.flatten_all()?.to_vec1()?;
            let input = format_args!("{self:?}, {:?}, w {}", x.dtype(), Preview(&w));
            cases.record_errors(input, [error])?;
            if !self.is_convolution() || x.dtype() == DType::U8 {
                return Ok(());
            }
            let bytes: Vec<u8> = (0..x.elem_count()).map(|_| cases.rng.random()).collect();
            operands[0] = Tensor::from_vec(bytes, x.shape(), &Device::Cpu)?;
        }
    }
}

/// Returns results and the gradients of inputs, weights and biases, flattened. Inputs of bytes have no gradient.
fn backprop(
    [x, w, b, g]: &Operands,
    layer: impl Fn(&[Var; 3]) -> candle_core::Result<Tensor>,
) -> anyhow::Result<[Vec<f64>; 4]> {
    let flat = |tensor: &Tensor| tensor.to_dtype(DType::F64)?.flatten_all()?.to_vec1::<f64>();
    let vars = [
        Var::from_tensor(x)?,
        Var::from_tensor(w)?,
        Var::from_tensor(b)?,
    ];
    let y = layer(&vars)?;
    let gradients = (&y * g)?.sum_all()?.backward()?;
    let grad = |var: &Var| match gradients.get(var) {
        Some(gradient) => Ok(flat(gradient)?),
        None if var.dtype() == DType::U8 => Ok(Vec::new()),
        None => anyhow::bail!("a layer without a gradient"),
    };
    Ok([flat(&y)?, grad(&vars[0])?, grad(&vars[1])?, grad(&vars[2])?])
}

fn uniform(count: usize, rng: &mut ChaCha8Rng) -> Vec<f32> {
    (0..count).map(|_| rng.random_range(-1.0..1.0)).collect()
}

/// Operands of at most this size have finite sums of products.
const MODERATE: f32 = 1e17;

fn draw_moderate(count: usize, rng: &mut ChaCha8Rng) -> Vec<f32> {
    draw_clamped(count, MODERATE, rng)
}

fn dense_by_size(cases: &mut Cases<'_>, precision: Precision) -> anyhow::Result<()> {
    let size = cases.one_of(&[0.0, 1e-45, 1e-40, 1e-38, 1e-20, 1.0, 1e17]);
    let other = cases.one_of(&[1e-40f32, 1e-20, 1.0, 1e17]);
    let layer = Layer::draw_dense(&mut cases.rng);
    let mut sizes = [other, size].into_iter().cycle();
    layer.record_errors(cases, precision, &mut |count, rng| {
        let size = sizes.next().unwrap_or(size);
        uniform(count, rng).into_iter().map(|x| x * size).collect()
    })
}

fn dense(cases: &mut Cases<'_>, precision: Precision) -> anyhow::Result<()> {
    let most = match precision {
        Precision::F32 => f32::MAX,
        // A larger operand would round to infinity.
        Precision::Bf16 => 3.38e38,
    };
    Layer::draw_dense(&mut cases.rng).record_errors(cases, precision, &mut |count, rng| {
        let is_moderate = rng.random_bool(0.7);
        draw_clamped(count, if is_moderate { MODERATE } else { most }, rng)
    })
}

fn convolution(cases: &mut Cases<'_>, precision: Precision) -> anyhow::Result<()> {
    let rng = &mut cases.rng;
    let kernel = rng.random_range(1..5);
    let sizes = [3, rng.random_range(1..6), rng.random_range(1..20)];
    let side = kernel + rng.random_range(0..6);
    let layer = Layer::new(sizes, [side, kernel, rng.random_range(1..4)]);
    layer.record_errors(cases, precision, &mut { draw_moderate })
}

fn procgen_layers(cases: &mut Cases<'_>, precision: Precision) -> anyhow::Result<()> {
    let layer = cases.one_of(&LAYERS);
    let mut draw = cases.one_of(&[uniform as fn(_, &mut _) -> _, draw_moderate]);
    layer.record_errors(cases, precision, &mut draw)
}

fn infinite(cases: &mut Cases<'_>, precision: Precision) -> anyhow::Result<()> {
    let inputs = cases.rng.random_range(1..200);
    let large = draw_finite(&mut cases.rng).abs().clamp(1e20, 1e38);
    let line = |x: f32| Tensor::full(x, (1, inputs), &Device::Cpu);
    let bias = Tensor::zeros(1, DType::F32, &Device::Cpu)?;
    let y = linear(&line(large)?, &line(1e20)?, &bias, precision)?;
    let y = y.flatten_all()?.to_vec1::<f32>()?[0];
    let input = format_args!("{inputs} times {large:e} times 1e20: {y:e}");
    cases.record_errors(input, [None, Some(f64::from(y.is_finite()))])
}

/// Checks that an infinity or NaN in a row shows in the results of this row, and changes no other row and no later call.
fn spoilt(cases: &mut Cases<'_>, precision: Precision) -> anyhow::Result<()> {
    let rng = &mut cases.rng;
    let mut layer = Layer::draw_dense(rng);
    layer.rows += 1;
    let [clean, w, b, _] = layer.operands(
        &mut |count, rng| (0..count).map(|_| rng.random_range(0.1..1.0)).collect(),
        rng,
    )?;
    let (bad, at) = (draw_nonfinite(rng), rng.random_range(0..clean.elem_count()));
    let mut x = clean.flatten_all()?.to_vec1::<f32>()?;
    x[at] = bad;
    let spoilt = Tensor::from_vec(x, clean.shape(), &Device::Cpu)?;
    let first = at / layer.inputs * layer.outputs;
    let own_outputs = first..first + layer.outputs;
    for with_relu in [false, true] {
        let results = |x: &Tensor| -> anyhow::Result<Vec<f32>> {
            let y = linear(x, &w, &b, precision)?.flatten_all()?;
            let y = if with_relu { relu(&y)? } else { y };
            Ok(y.to_vec1()?)
        };
        let (before, mut spoilt, after) = (results(&clean)?, results(&spoilt)?, results(&clean)?);
        // ReLU may hide -inf, because max(0, -inf) is 0.
        let may_hide = with_relu && bad == f32::NEG_INFINITY;
        let shows = may_hide || !spoilt[own_outputs.clone()].iter().any(|y| y.is_finite());
        spoilt[own_outputs.clone()].copy_from_slice(&before[own_outputs.clone()]);
        let kept = [spoilt, after].iter().all(|it| bits(it) == bits(&before));
        let input = format_args!("{bad} at {at} of {layer:?}");
        cases.record_errors(input, [None, Some(f64::from(!(shows && kept)))])?;
    }
    Ok(())
}
