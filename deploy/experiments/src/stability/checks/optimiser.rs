//! Routines around the optimiser: the global gradient norm, the clipping factor, and the updates of the target network.

use candle_core::{Device, Tensor};
use driml_learner::{
    Kernels,
    optimiser::{
        gradients::{Gradients, NORM_ERROR, clip_factor},
        target::{FOLLOWED_MAX, follow, follow_error},
    },
};
use driml_model::ModelConfig;

use crate::{small, stability::property::*};

const NORMS: &str =
    "all 0, 1e-45, 1e-38, 1e20, 3.4e38; one of 3.4e38 among 1e-45; 10 and 131,000 of them";
const MOVES: &str =
    "3 / tau moves towards a network that stands still; tau 0.95, 0.5, 0.005, 1e-3, 1e-4, 1e-5";
const A_FEW_MOVES: &str = "drawn, up to 30 moves towards a network that moves";

pub(super) fn properties() -> Vec<Property> {
    let limits = "max_grad_norm 1e-6 to 1e15; norms up to 8e37 times it";
    vec![
        Property::new("gradient norm", "gradients finite")
            .promise("the norm, as a share of it", NORM_ERROR)
            .promise("cases not refused by the parameter's name", 0.0)
            .check(NORMS, Listed, norm)
            .check("drawn", Drawn(0.05), norm)
            .check("one is infinite or not a number", Drawn(0.05), bad_gradient),
        Property::new("clipping", limits)
            .promise("share by which a norm is above the limit", 6.1e-8)
            .check("norms 0 to 3.4e38, limits 1e-6 to 1e15", Listed, clipping)
            .check("drawn, half of them near the limit", Drawn(10.0), clipping),
        Property::new("target network", "tau 1e-5 to 1; parameters within 1.7e38")
            // The error is relative to the largest value that the parameter had in either network.
            .promise("a parameter, as a share of `follow_error`", 1.0)
            .promise("copies of other bits", 0.0)
            .check(MOVES, Listed, check_follow)
            .check(A_FEW_MOVES, Drawn(0.02), check_follow)
            .check("tau 1, drawn", Drawn(0.02), check_copy),
    ]
}

/// Returns gradients with these values, one parameter after the other. They come from the loss: sum of parameter times value.
fn gradients(config: &ModelConfig, values: &[f32]) -> anyhow::Result<Gradients> {
    let parameters = small::parameters(config, &[])?;
    let slopes = small::tensors(config, values)?;
    let mut sum = Tensor::new(0f32, &Device::Cpu)?;
    for (name, var) in parameters.iter() {
        sum = (sum + (var.as_tensor() * &slopes[name])?.sum_all()?)?;
    }
    Ok(Gradients::compute(&parameters, &sum)?)
}

fn norm(cases: &mut Cases<'_>) -> anyhow::Result<()> {
    let sizes = cases.listed_or(&[(2, 1), (512, 256)], |_| (17, 13));
    let config = small::config(sizes.0, sizes.1, (-1.0, 1.0));
    let len = small::scalar_count(&config);
    let values = cases.listed_or(&extremes(len), |rng| draw_finites(len, rng));
    let norm = gradients(&config, &values)?.norm(Kernels::FUSED)?;
    // The reference is the largest |value| times the norm of all values divided by it.
    let largest = f64::from(values.iter().fold(0.0f32, |most, x| most.max(x.abs())));
    let squares = values.iter().map(|x| (f64::from(*x) / largest).powi(2));
    let error = match largest {
        0.0 => norm,
        _ => norm / (largest * exact_sum(squares).sqrt()) - 1.0,
    };
    cases.record_errors(format_args!("{}", Preview(&values)), [error])
}

fn bad_gradient(cases: &mut Cases<'_>) -> anyhow::Result<()> {
    let config = small::config(17, 13, (-1.0, 1.0));
    let mut values = draw_finites(small::scalar_count(&config), &mut cases.rng);
    let at = cases.rng.random_range(0..values.len());
    values[at] = draw_nonfinite(&mut cases.rng);
    let text = gradients(&config, &values)?.norm(Kernels::FUSED);
    let text = text.map_or_else(|e| e.to_string(), |norm| format!("a norm of {norm}"));
    let is_named = text.starts_with("the gradient of ") && text.contains(" is not finite");
    let error = f64::from(!is_named);
    cases.record_errors(format_args!("{text}"), [None, Some(error)])
}

fn clipping(cases: &mut Cases<'_>) -> anyhow::Result<()> {
    let limits = [1e-6, 1e-3, 1.0, 10.0, 1e15];
    let limit: f64 = cases.listed_or(&limits, |rng| 10f64.powf(rng.random_range(-6.0..=15.0)));
    let norms = [
        0.0, 1e-45, 1e-7, 1e-6, 1e-5, 1.0, 9.999, 10.0, 10.001, 1e15, 1e30, 3.4e38,
    ];
    let norm = cases.listed_or(&norms, |rng| match rng.random_bool(0.5) {
        true => 10f64.powf(rng.random_range(-45.0..=38.6)),
        false => limit * (1.0 + rng.random_range(-1e-6..1e-6)),
    });
    if norm <= 8e37 * limit {
        // The optimiser step uses the factor as f32.
        let factor = f64::from(clip_factor(norm, limit) as f32);
        let is_right = factor == 1.0 || (norm + 1e-6 > limit && (0.0..1.0).contains(&factor));
        let error = nan_unless(is_right, (factor * norm / limit - 1.0).max(0.0));
        cases.record_errors(format_args!("norm {norm:e}, limit {limit:e}"), [error])?;
    }
    Ok(())
}

/// Checks a target network of the smallest kind that follows one online network after the other.
fn check_follow(cases: &mut Cases<'_>) -> anyhow::Result<()> {
    let start = vec![-0.4, -1.1, 0.6, 2.6, 0.0, 1e-45, -1e30, 1.0];
    let start = cases.listed_or(&[start], |rng| draw_clamped(10, FOLLOWED_MAX, rng));
    let taus = [0.95, 0.5, 0.005, 1e-3, 1e-4, 1e-5];
    let tau: f64 = cases.listed_or(&taus, |rng| 10f64.powf(rng.random_range(-5.0..0.0)));
    // Each entry has the number of moves, and the online network that the target moves towards.
    let end = vec![0.7, -1.3, 0.011, 2.5, 1e-38, 1e-40, 1e30, -1.0];
    let stages: Vec<(u64, Vec<f32>)> = cases.listed_or(&[vec![((3.0 / tau) as u64, end)]], |rng| {
        let count = rng.random_range(1..8);
        let draw_stage = |_| (rng.random_range(1..5), draw_clamped(10, FOLLOWED_MAX, rng));
        (0..count).map(draw_stage).collect()
    });
    let target = small::parameters(&small::minimal_config(), &start)?;
    // Each parameter in f64, and the largest absolute value that it had in either network.
    let mut exact: Vec<_> = to_f64(&start).iter().map(|&x| (x, x.abs())).collect();
    for (moves, online) in &stages {
        let source = small::parameters(&small::minimal_config(), online)?;
        for _ in 0..*moves {
            follow(&target, &source, tau, Kernels::FUSED)?;
        }
        // All moves at once: the remaining share of the distance is (1 - tau)^moves.
        let share_left = (*moves as f64 * (-tau).ln_1p()).exp();
        for ((exact, largest), online) in exact.iter_mut().zip(to_f64(online)) {
            *exact = online + share_left * (*exact - online);
            *largest = largest.max(online.abs());
        }
    }
    let found = to_f64(&small::scalars(&small::minimal_config(), &target)?);
    let errors = found.iter().zip(exact).map(|(found, (exact, largest))| {
        (found - exact).abs() / largest.max(MIN_NORMAL) / follow_error(tau)
    });
    let moves: u64 = stages.iter().map(|(moves, _)| moves).sum();
    let input = format_args!("tau {tau:e}, {moves} moves, from {}", Preview(&start));
    cases.record_errors(input, [max_error(errors)])
}

fn check_copy(cases: &mut Cases<'_>) -> anyhow::Result<()> {
    let config = small::minimal_config();
    let target = small::parameters(&config, &draw_finites(10, &mut cases.rng))?;
    let online = draw_finites(8, &mut cases.rng);
    let source = small::parameters(&config, &online)?;
    follow(&target, &source, 1.0, Kernels::FUSED)?;
    for (found, online) in small::scalars(&config, &target)?.iter().zip(&online) {
        let error = f64::from(found.to_bits() != online.to_bits());
        cases.record_errors(format_args!("{online:e}"), [None, Some(error)])?;
    }
    Ok(())
}
