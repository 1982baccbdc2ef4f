//! The norm of all gradients together, and the factor that clips it.

use candle_core::{Device, Tensor};
use driml_learner::{
    Kernels,
    optimiser::gradients::{Gradients, NORM_ERROR, clip_factor},
};
use driml_model::ModelConfig;
use rand::Rng;

use crate::stability::{
    check::{Context, Routine, Row},
    edges::{exact_sum, finites, shown},
    small,
};

const NORM: Routine = Routine {
    name: "gradient norm",
    range: "gradients finite",
};
const CLIPPING: Routine = Routine {
    name: "clipping",
    range: "max_grad_norm 1e-6 to 1e15; norms up to 8e37 times it",
};

/// Gradients with these values, one parameter after the other: those of the sum of each parameter times its value.
pub(super) fn gradients(config: &ModelConfig, values: &[f32]) -> anyhow::Result<Gradients> {
    let parameters = small::parameters(config, &vec![0.0; values.len()])?;
    let (mut sum, mut rest) = (Tensor::new(0f32, &Device::Cpu)?, values);
    for (name, shape) in config.parameter_shapes() {
        let (first, after) = rest.split_at(shape.iter().product());
        rest = after;
        if let Some(var) = parameters.get(&name) {
            let slope = Tensor::from_slice(first, shape, &Device::Cpu)?;
            sum = (sum + (var.as_tensor() * slope)?.sum_all()?)?;
        }
    }
    Ok(Gradients::of(&parameters, &sum)?)
}

/// The largest value's size times the norm of what is left.
fn norm_of(values: &[f32]) -> f64 {
    let largest = values.iter().fold(0.0f32, |most, x| most.max(x.abs()));
    if largest == 0.0 {
        return 0.0;
    }
    let share = |x: &f32| f64::from(*x) / f64::from(largest);
    let sum = exact_sum(values.iter().map(|x| share(x) * share(x)));
    f64::from(largest) * sum.sqrt()
}

pub(super) fn check(context: &mut Context<'_>) -> anyhow::Result<Vec<Row>> {
    let row = |extreme: &str| {
        Row::new(
            NORM,
            extreme,
            "error of the norm, as a share of it",
            NORM_ERROR,
        )
    };
    let see = |row: &mut Row, config: &ModelConfig, values: &[f32]| -> anyhow::Result<()> {
        let norm = gradients(config, values)?.norm(Kernels::FUSED)?;
        let expected = norm_of(values);
        let error = if expected == 0.0 {
            norm
        } else {
            norm / expected - 1.0
        };
        row.see(error, || shown(values));
        Ok(())
    };
    let mut listed =
        row("all 0, 1e-45, 1e-38, 1e20, 3.4e38; one of 3.4e38 among 1e-45; 10 and 131,000 of them");
    let large = small::config(512, 256, (-1.0, 1.0));
    for config in [&small::least(), &large] {
        let len = small::len(config);
        for value in [0.0, 1e-45, 1e-38, 0.1, 1e20, f32::MAX] {
            see(&mut listed, config, &vec![value; len])?;
        }
        let mut one = vec![1e-45; len];
        one[len / 2] = f32::MAX;
        see(&mut listed, config, &one)?;
    }
    let middle = small::config(17, 13, (-1.0, 1.0));
    let len = small::len(&middle);
    let mut drawn = row("drawn");
    let mut refused = Row::new(
        NORM,
        "one is infinite or no number",
        "cases in which it is not refused by its parameter's name",
        0.0,
    );
    context.draw(0.05, |_, rng| {
        let mut values = finites(len, rng);
        see(&mut drawn, &middle, &values)?;
        let bad = [f32::INFINITY, f32::NEG_INFINITY, f32::NAN];
        values[rng.random_range(0..len)] = bad[rng.random_range(0..3)];
        let said = gradients(&middle, &values)?.norm(Kernels::FUSED);
        let said = said.map_or_else(|e| e.to_string(), |norm| format!("a norm of {norm}"));
        let by_name = said.starts_with("the gradient of ") && said.contains(" is not finite");
        refused.must(by_name, || said.clone());
        Ok(())
    })?;
    let mut rows = vec![listed, drawn, refused];
    rows.extend(clipping(context)?);
    Ok(rows)
}

fn clipping(context: &mut Context<'_>) -> anyhow::Result<Vec<Row>> {
    let mut row = Row::new(
        CLIPPING,
        "norms 0 to 3.4e38 and drawn, limits 1e-6 to 1e15",
        "share by which a clipped norm is above the limit",
        6.1e-8,
    );
    let see = |row: &mut Row, norm: f64, limit: f64| {
        if norm > 8e37 * limit {
            return;
        }
        // As the step uses it.
        let factor = f64::from(clip_factor(norm, limit) as f32);
        let whole = norm + 1e-6 <= limit;
        let error = if (whole && factor != 1.0) || !(0.0..=1.0).contains(&factor) {
            f64::MAX
        } else {
            (factor * norm / limit - 1.0).max(0.0)
        };
        row.see(error, || format!("norm {norm:e}, limit {limit:e}"));
    };
    for limit in [1e-6, 1e-3, 1.0, 10.0, 1e15] {
        for norm in [
            0.0, 1e-45, 1e-7, 1e-6, 1e-5, 1.0, 9.999, 10.0, 10.001, 1e15, 1e30, 3.4e38,
        ] {
            see(&mut row, norm, limit);
        }
    }
    context.draw(5.0, |_, rng| {
        let limit = 10f64.powf(rng.random_range(-6.0..=15.0));
        let norm = 10f64.powf(rng.random_range(-45.0..=38.6));
        see(&mut row, norm, limit);
        let near = limit * (1.0 + rng.random_range(-1e-6..1e-6));
        see(&mut row, near, limit);
        Ok(())
    })?;
    Ok(vec![row])
}
