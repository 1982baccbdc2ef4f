//! Products of the network, fully connected and convolutional, in f32 and bf16; and numbers that are none on their way through.

use candle_core::{Device, Tensor, Var};
use driml_model::{Precision, conv2d_relu, linear, linear_relu};
use rand::Rng;
use rand_chacha::ChaCha8Rng;

use crate::stability::{
    check::{Context, Routine, Row},
    edges::{finite, finites, shown, widened},
    routines::losses::worse,
};

const F32: Routine = Routine {
    name: "products, f32",
    range: "operands finite, the sum of their products' sizes below 3.4e38",
};
const BF16: Routine = Routine {
    name: "products, bf16",
    range: "operands within 3.38e38, the sum of their products' sizes below 3.3e38",
};

const fn routine(precision: Precision) -> Routine {
    match precision {
        Precision::F32 => F32,
        Precision::Bf16 => BF16,
    }
}

/// What a sum of products should be, the sum of the products' sizes, their number, and the size of the largest operand.
#[derive(Default)]
struct Sum {
    value: f64,
    sizes: f64,
    terms: usize,
    largest: f64,
}

impl Sum {
    fn add(&mut self, a: f64, b: f64) {
        self.value += a * b;
        self.sizes += (a * b).abs();
        self.terms += 1;
        self.largest = self.largest.max(a.abs()).max(b.abs());
    }

    /// The error of `found`, as a share of what is promised; none where the promise does not hold.
    fn error(&self, found: f32, precision: Precision) -> Option<f64> {
        // Rounding to bf16 may add a 128th.
        if self.sizes * 1.01 >= f64::from(f32::MAX) || self.largest > 3.38e38 {
            return None;
        }
        let allowed = precision.product_error(self.terms) * self.sizes
            + precision.product_floor(self.terms, self.largest);
        let error = (f64::from(found) - self.value).abs();
        Some(if error == 0.0 { 0.0 } else { error / allowed })
    }
}

/// Errors of many sums, of which the worst counts.
fn worst<'a>(
    found: impl IntoIterator<Item = &'a f32>,
    sums: impl IntoIterator<Item = Sum>,
    precision: Precision,
) -> f64 {
    let each = found.into_iter().zip(sums);
    let errors = each.filter_map(|(found, sum)| sum.error(*found, precision));
    errors.fold(0.0, worse)
}

fn tensor(values: &[f32], shape: &[usize]) -> candle_core::Result<Var> {
    Var::from_tensor(&Tensor::from_slice(values, shape, &Device::Cpu)?)
}

fn flat(tensor: &Tensor) -> candle_core::Result<Vec<f32>> {
    tensor.flatten_all()?.to_vec1()
}

/// A fully connected layer and the gradient of its results.
struct Layer {
    rows: usize,
    inputs: usize,
    outputs: usize,
    x: Vec<f32>,
    w: Vec<f32>,
    b: Vec<f32>,
    g: Vec<f32>,
}

impl Layer {
    fn drawn(
        rng: &mut ChaCha8Rng,
        mut values: impl FnMut(usize, &mut ChaCha8Rng) -> Vec<f32>,
    ) -> Self {
        let (rows, inputs, outputs) = (
            rng.random_range(1..40),
            rng.random_range(1..200),
            rng.random_range(1..40),
        );
        Self {
            x: values(rows * inputs, rng),
            w: values(outputs * inputs, rng),
            b: values(outputs, rng),
            g: values(rows * outputs, rng),
            rows,
            inputs,
            outputs,
        }
    }

    /// The worst error of results and gradients.
    fn error(&self, precision: Precision) -> anyhow::Result<f64> {
        let Self {
            rows,
            inputs,
            outputs,
            ..
        } = *self;
        let x = tensor(&self.x, &[rows, inputs])?;
        let w = tensor(&self.w, &[outputs, inputs])?;
        let b = tensor(&self.b, &[outputs])?;
        let y = linear(&x, &w, &b, precision)?;
        let slope = Tensor::from_slice(&self.g, (rows, outputs), &Device::Cpu)?;
        let gradients = (&y * &slope)?.sum_all()?.backward()?;
        let (xs, ws, bs, gs) = (
            widened(&self.x),
            widened(&self.w),
            widened(&self.b),
            widened(&self.g),
        );
        let sum = |terms: &mut dyn Iterator<Item = (f64, f64)>| {
            let mut sum = Sum::default();
            terms.for_each(|(a, b)| sum.add(a, b));
            sum
        };
        let y_of = |at: usize| {
            let (r, o) = (at / outputs, at % outputs);
            let mut terms = (0..inputs).map(|i| (xs[r * inputs + i], ws[o * inputs + i]));
            let mut sum = sum(&mut terms);
            sum.value += bs[o];
            sum.sizes += bs[o].abs();
            sum
        };
        let x_of = |at: usize| {
            let (r, i) = (at / inputs, at % inputs);
            sum(&mut (0..outputs).map(|o| (gs[r * outputs + o], ws[o * inputs + i])))
        };
        let w_of = |at: usize| {
            let (o, i) = (at / inputs, at % inputs);
            sum(&mut (0..rows).map(|r| (gs[r * outputs + o], xs[r * inputs + i])))
        };
        let b_of = |o: usize| sum(&mut (0..rows).map(|r| (gs[r * outputs + o], 1.0)));
        let gradient = |var: &Var| -> anyhow::Result<Vec<f32>> {
            let missing = || anyhow::anyhow!("a layer without a gradient");
            Ok(flat(gradients.get(var).ok_or_else(missing)?)?)
        };
        let errors = [
            worst(&flat(&y)?, (0..rows * outputs).map(y_of), precision),
            worst(&gradient(&x)?, (0..rows * inputs).map(x_of), precision),
            worst(&gradient(&w)?, (0..outputs * inputs).map(w_of), precision),
            // Sums of gradients are no products, and f32 in either precision.
            worst(&gradient(&b)?, (0..outputs).map(b_of), Precision::F32),
        ];
        Ok(errors.into_iter().fold(0.0, worse))
    }

    fn shown(&self) -> String {
        let Self {
            rows,
            inputs,
            outputs,
            ..
        } = *self;
        format!(
            "{rows} x {inputs} to {outputs}: x {}, w {}",
            shown(&self.x),
            shown(&self.w)
        )
    }
}

fn row(precision: Precision, extreme: &str) -> Row {
    let promise = match precision {
        Precision::F32 => {
            "error, as a share of (terms + 2) 2^-24 of the products' sizes + terms 2^-150"
        }
        Precision::Bf16 => {
            "error, as a share of (2^-7 + terms 2^-24) of the products' sizes + 1.2e-38 of each operand, product and sum"
        }
    };
    Row::new(routine(precision), extreme, promise, 1.0)
}

/// So large that no product of two leaves the finite numbers.
fn moderate(mut values: Vec<f32>) -> Vec<f32> {
    values.iter_mut().for_each(|x| *x = x.clamp(-1e17, 1e17));
    values
}

fn dense(context: &mut Context<'_>, precision: Precision) -> anyhow::Result<Vec<Row>> {
    let mut listed = row(
        precision,
        "fully connected, results and gradients: operands of 0, 1e-45, 1e-40, 1e-38, 1e-20, 1, 1e17, one among others",
    );
    for size in [0.0, 1e-45, 1e-40, 1e-38, 1e-20, 1.0, 1e17] {
        for other in [1e-40f32, 1e-20, 1.0, 1e17] {
            let mut turn = 0;
            let layer = Layer::drawn(&mut context.rng, |count, rng| {
                turn += 1;
                let size = if turn % 2 == 0 { size } else { other };
                (0..count)
                    .map(|_| size * rng.random_range(-1.0f32..1.0))
                    .collect()
            });
            listed.see(layer.error(precision)?, || layer.shown());
        }
    }
    let mut drawn = row(precision, "fully connected, results and gradients, drawn");
    context.draw(0.02, |_, rng| {
        let layer = Layer::drawn(rng, |count, rng| match rng.random_bool(0.7) {
            true => moderate(finites(count, rng)),
            false => finites(count, rng),
        });
        drawn.see(layer.error(precision)?, || layer.shown());
        Ok(())
    })?;
    Ok(vec![listed, drawn])
}

/// Images [B, side, side, channels] under one convolution.
struct Picture {
    side: usize,
    channels: usize,
    kernel: usize,
    stride: usize,
    out: usize,
}

const IMAGES: usize = 3;

impl Picture {
    fn drawn(rng: &mut ChaCha8Rng) -> Self {
        let kernel = rng.random_range(1..5);
        Self {
            side: kernel + rng.random_range(0..6),
            channels: rng.random_range(1..6),
            kernel,
            stride: rng.random_range(1..4),
            out: rng.random_range(1..20),
        }
    }

    /// The worst error of results and of the weights' gradients, of images of these pixels.
    fn error(
        &self,
        (images, pixels): (&Tensor, &[f64]),
        (w, b): (&[f32], &[f32]),
        precision: Precision,
    ) -> anyhow::Result<f64> {
        let Self {
            side,
            channels,
            kernel,
            stride,
            out,
        } = *self;
        let weight = tensor(w, &[out, channels, kernel, kernel])?;
        let bias = tensor(b, &[out])?;
        let y = conv2d_relu(images, &weight, &bias, stride, precision)?;
        let gradients = y.sum_all()?.backward()?;
        let places = (side - kernel) / stride + 1;
        let found = flat(&y)?;
        let pixel = |image: usize, r: usize, c: usize, i: usize| {
            pixels[((image * side + r) * side + c) * channels + i]
        };
        let at = |index: usize| {
            let (o, place) = (index % out, index / out);
            (
                place / (places * places),
                place / places % places,
                place % places,
                o,
            )
        };
        let bytes = images.dtype() == candle_core::DType::U8;
        let y_of = |index: usize| {
            let (image, r, c, o) = at(index);
            let mut sum = Sum::default();
            for i in 0..channels {
                for (kr, kc) in (0..kernel * kernel).map(|k| (k / kernel, k % kernel)) {
                    let w = w[((o * channels + i) * kernel + kr) * kernel + kc];
                    sum.add(pixel(image, r * stride + kr, c * stride + kc, i), w.into());
                }
            }
            sum.value += f64::from(b[o]);
            sum.sizes += f64::from(b[o]).abs();
            // A byte / 255 has two roundings of its own.
            sum.terms += if bytes { 2 } else { 0 };
            sum
        };
        let results = (0..found.len()).filter_map(|index| {
            let mut sum = y_of(index);
            let cut = sum.value.max(0.0);
            let error = sum.error(found[index], precision);
            // Below 0 it is 0, and what is near 0 may be either.
            sum.value = cut;
            let cut = sum.error(found[index], precision);
            Some(cut?.min(error?))
        });
        let forward = results.fold(0.0, worse);
        let w_of = |index: usize| {
            let (kc, kr) = (index % kernel, index / kernel % kernel);
            let (i, o) = (
                index / (kernel * kernel) % channels,
                index / (kernel * kernel * channels),
            );
            let mut sum = Sum::default();
            for (index, found) in found.iter().enumerate() {
                let (image, r, c, of) = at(index);
                if of == o && *found > 0.0 {
                    sum.add(pixel(image, r * stride + kr, c * stride + kc, i), 1.0);
                }
            }
            sum.terms += if bytes { 2 } else { 0 };
            sum
        };
        let gradient = gradients.get(&weight).map(flat).transpose()?;
        let backward = worst(
            &gradient.unwrap_or_default(),
            (0..w.len()).map(w_of),
            precision,
        );
        Ok(worse(forward, backward))
    }
}

fn convolutions(context: &mut Context<'_>, precision: Precision) -> anyhow::Result<Vec<Row>> {
    let mut floats = row(
        precision,
        "convolution with ReLU, results and weights' gradients, drawn",
    );
    let mut bytes = row(precision, "the same on bytes 0 to 255");
    context.draw(0.02, |_, rng| {
        let picture = Picture::drawn(rng);
        let Picture {
            side,
            channels,
            kernel,
            out,
            ..
        } = picture;
        let shape = (IMAGES, side, side, channels);
        let count = IMAGES * side * side * channels;
        let w = moderate(finites(out * channels * kernel * kernel, rng));
        let b = moderate(finites(out, rng));
        let x = moderate(finites(count, rng));
        let images = Tensor::from_slice(&x, shape, &Device::Cpu)?;
        let input = || {
            format!(
                "side {side}, kernel {kernel}, x {}, w {}",
                shown(&x),
                shown(&w)
            )
        };
        floats.see(
            picture.error((&images, &widened(&x)), (&w, &b), precision)?,
            input,
        );
        let x: Vec<u8> = (0..count).map(|_| rng.random()).collect();
        let images = Tensor::from_slice(&x, shape, &Device::Cpu)?;
        let pixels: Vec<f64> = x.iter().map(|&x| f64::from(x) / 255.0).collect();
        bytes.see(
            picture.error((&images, &pixels), (&w, &b), precision)?,
            input,
        );
        Ok(())
    })?;
    Ok(vec![floats, bytes])
}

/// A row with a number that is none spoils itself, visibly, and nothing else.
fn spoilt(context: &mut Context<'_>, precision: Precision) -> anyhow::Result<Row> {
    let mut row = Row::new(
        routine(precision),
        "one operand infinite or no number, before and after ReLU",
        "rows that hide it, other rows and later calls whose bits differ",
        0.0,
    );
    context.draw(0.02, |_, rng| {
        let (rows, inputs, outputs) = (
            rng.random_range(2..40),
            rng.random_range(1..200),
            rng.random_range(1..40),
        );
        let mut usual = |count: usize| -> Vec<f32> {
            (0..count).map(|_| rng.random_range(0.1f32..1.0)).collect()
        };
        let (clean, w, b) = (
            usual(rows * inputs),
            usual(outputs * inputs),
            usual(outputs),
        );
        let bad = [f32::INFINITY, f32::NEG_INFINITY, f32::NAN][rng.random_range(0..3)];
        let at = rng.random_range(0..rows * inputs);
        let mut x = clean.clone();
        x[at] = bad;
        let apply = |x: &[f32], with_relu: bool| -> anyhow::Result<Vec<u32>> {
            let layer = if with_relu { linear_relu } else { linear };
            let (x, w, b) = (
                tensor(x, &[rows, inputs])?,
                tensor(&w, &[outputs, inputs])?,
                tensor(&b, &[outputs])?,
            );
            let y = flat(&layer(&x, &w, &b, precision)?)?;
            Ok(y.iter().map(|y| y.to_bits()).collect())
        };
        for with_relu in [false, true] {
            let before = apply(&clean, with_relu)?;
            let spoilt = apply(&x, with_relu)?;
            let after = apply(&clean, with_relu)?;
            let own = at / inputs * outputs..(at / inputs + 1) * outputs;
            // The largest of 0 and -inf is 0.
            let may_hide = with_relu && bad == f32::NEG_INFINITY;
            let shows = may_hide
                || spoilt[own.clone()]
                    .iter()
                    .all(|&y| !f32::from_bits(y).is_finite());
            let others = (0..before.len()).filter(|at| !own.contains(at));
            let same = others.clone().all(|at| before[at] == spoilt[at]) && before == after;
            row.must(shows && same, || {
                format!("{bad} at {at} of {rows} x {inputs} to {outputs}")
            });
        }
        Ok(())
    })?;
    Ok(row)
}

/// Products that are too large are infinite, and seen.
fn overflow(context: &mut Context<'_>, precision: Precision) -> anyhow::Result<Row> {
    let mut row = Row::new(
        routine(precision),
        "products beyond 3.4e38, all of one sign",
        "results that are finite all the same",
        0.0,
    );
    context.draw(0.01, |_, rng| {
        let inputs = rng.random_range(1..200);
        let large = finite(rng).abs().clamp(1e20, 1e38);
        let (x, w, b) = (
            tensor(&vec![large; inputs], &[1, inputs])?,
            tensor(&vec![1e20; inputs], &[1, inputs])?,
            tensor(&[0.0], &[1])?,
        );
        let y = flat(&linear(&x, &w, &b, precision)?)?[0];
        row.must(!y.is_finite(), || {
            format!("{inputs} times {large:e} times 1e20: {y:e}")
        });
        Ok(())
    })?;
    Ok(row)
}

pub(super) fn check(context: &mut Context<'_>) -> anyhow::Result<Vec<Row>> {
    let mut rows = Vec::new();
    for precision in Precision::ALL {
        rows.extend(dense(context, precision)?);
        rows.extend(convolutions(context, precision)?);
        rows.push(spoilt(context, precision)?);
        rows.push(overflow(context, precision)?);
    }
    Ok(rows)
}
