//! What is no number, or leaves the numbers, on its way through products.

use driml_model::{Precision, linear, linear_relu};
use rand::Rng;

use super::sums::{flat, routine, tensor};
use crate::stability::{
    check::{Context, Row},
    edges::finite,
};

/// A row with a number that is none spoils itself, visibly, and nothing else.
fn hidden(context: &mut Context<'_>, precision: Precision) -> anyhow::Result<Row> {
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

pub(super) fn check(context: &mut Context<'_>, precision: Precision) -> anyhow::Result<Vec<Row>> {
    Ok(vec![
        hidden(context, precision)?,
        overflow(context, precision)?,
    ])
}
