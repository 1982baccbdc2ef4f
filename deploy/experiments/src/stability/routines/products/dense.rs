//! Fully connected layers against float64: results, and gradients of inputs, weights and biases.

use candle_core::{Device, Tensor, Var};
use driml_model::{Precision, linear};
use rand::Rng;
use rand_chacha::ChaCha8Rng;

use super::sums::{Sum, flat, moderate, places, row, tensor, worst};
use crate::stability::{
    check::{Context, Row},
    edges::{finites, shown, widened},
    routines::losses::worse,
};

/// Rows, inputs and outputs: from the maps to the hidden layer, from there to the atoms of 15 actions, and each place of a map to a score of DIM.
const REAL: [(usize, usize, usize); 3] = [(256, 1024, 512), (256, 512, 765), (4096, 64, 512)];

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
    /// A small one.
    fn drawn(rng: &mut ChaCha8Rng, values: impl FnMut(usize, &mut ChaCha8Rng) -> Vec<f32>) -> Self {
        let sizes = (
            rng.random_range(1..40),
            rng.random_range(1..200),
            rng.random_range(1..40),
        );
        Self::of(sizes, rng, values)
    }

    /// One with these numbers of rows, inputs and outputs.
    fn of(
        (rows, inputs, outputs): (usize, usize, usize),
        rng: &mut ChaCha8Rng,
        mut values: impl FnMut(usize, &mut ChaCha8Rng) -> Vec<f32>,
    ) -> Self {
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
    fn error(&self, precision: Precision, rng: &mut ChaCha8Rng) -> anyhow::Result<f64> {
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
        let mut of = |found: &[f32], sum_of: &dyn Fn(usize) -> Sum, precision| {
            worst(found, &places(found.len(), rng), sum_of, precision)
        };
        let errors = [
            of(&flat(&y)?, &y_of, precision),
            of(&gradient(&x)?, &x_of, precision),
            of(&gradient(&w)?, &w_of, precision),
            // Sums of gradients are no products, and f32 in either precision.
            of(&gradient(&b)?, &b_of, Precision::F32),
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

pub(super) fn check(context: &mut Context<'_>, precision: Precision) -> anyhow::Result<Vec<Row>> {
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
            let error = layer.error(precision, &mut context.rng)?;
            listed.see(error, || layer.shown());
        }
    }
    let mut drawn = row(precision, "fully connected, results and gradients, drawn");
    context.draw(0.02, |_, rng| {
        let layer = Layer::drawn(rng, |count, rng| match rng.random_bool(0.7) {
            true => moderate(finites(count, rng)),
            false => finites(count, rng),
        });
        drawn.see(layer.error(precision, rng)?, || layer.shown());
        Ok(())
    })?;
    let mut real = row(
        precision,
        "the same at the sizes of Procgen's network and DIM's heads, 4,000 places of each tensor",
    );
    for sizes in REAL {
        for moderately in [true, false] {
            let layer = Layer::of(sizes, &mut context.rng, |count, rng| match moderately {
                true => (0..count).map(|_| rng.random_range(-1.0..1.0)).collect(),
                false => moderate(finites(count, rng)),
            });
            let error = layer.error(precision, &mut context.rng)?;
            real.see(error, || layer.shown());
        }
        context.progress.advance(0)?;
    }
    Ok(vec![listed, drawn, real])
}
