//! Around the optimiser: the norm of all gradients together, the factor that clips it, and the target network's moves.

use candle_core::{Device, Tensor};
use driml_learner::{
    Kernels,
    optimiser::{
        gradients::{Gradients, clip_factor},
        target::{FOLLOWED_MAX, follow, follow_error},
    },
};
use driml_model::{ModelConfig, Parameters};
use rand::Rng;

use crate::stability::{
    edges::{Shown, clamped, exact_sum, finites, not_finite, worst},
    property::{Cases, broken},
    small,
};

/// Gradients with these values, one parameter after the other: those of the sum of each parameter times its value.
pub(super) fn gradients(config: &ModelConfig, values: &[f32]) -> anyhow::Result<Gradients> {
    let parameters = small::parameters(config, &vec![0.0; values.len()])?;
    let slopes = small::tensors(config, values)?;
    let mut sum = Tensor::new(0f32, &Device::Cpu)?;
    for (name, var) in parameters.iter() {
        if let Some(slope) = slopes.get(name) {
            sum = (sum + (var.as_tensor() * slope)?.sum_all()?)?;
        }
    }
    Ok(Gradients::of(&parameters, &sum)?)
}

fn see_norm(
    extreme: &str,
    cases: &mut Cases<'_>,
    config: &ModelConfig,
    values: &[f32],
) -> anyhow::Result<()> {
    let norm = gradients(config, values)?.norm(Kernels::FUSED)?;
    // The largest value's size times the norm of the shares of it.
    let largest = f64::from(values.iter().fold(0.0f32, |most, x| most.max(x.abs())));
    let error = match largest {
        0.0 => norm,
        _ => {
            let squares = values.iter().map(|x| (f64::from(*x) / largest).powi(2));
            norm / (largest * exact_sum(squares).sqrt()) - 1.0
        }
    };
    Ok(cases.see(extreme, format_args!("{}", Shown(values)), [error])?)
}

pub(crate) fn norm(cases: &mut Cases<'_>) -> anyhow::Result<()> {
    let listed =
        "all 0, 1e-45, 1e-38, 1e20, 3.4e38; one of 3.4e38 among 1e-45; 10 and 131,000 of them";
    for config in [small::least(), small::config(512, 256, (-1.0, 1.0))] {
        let len = small::len(&config);
        for value in [0.0, 1e-45, 1e-38, 0.1, 1e20, f32::MAX] {
            see_norm(listed, cases, &config, &vec![value; len])?;
        }
        let mut one = vec![1e-45; len];
        one[len / 2] = f32::MAX;
        see_norm(listed, cases, &config, &one)?;
    }
    let config = small::config(17, 13, (-1.0, 1.0));
    let len = small::len(&config);
    for _ in cases.draws(0.05) {
        let mut values = finites(len, &mut cases.rng);
        see_norm("drawn", cases, &config, &values)?;
        values[cases.rng.random_range(0..len)] = not_finite(&mut cases.rng);
        let said = gradients(&config, &values)?.norm(Kernels::FUSED);
        let said = said.map_or_else(|e| e.to_string(), |norm| format!("a norm of {norm}"));
        let by_name = said.starts_with("the gradient of ") && said.contains(" is not finite");
        let extreme = "one is infinite or not a number";
        cases.see(
            extreme,
            format_args!("{said}"),
            [None, Some(broken(by_name))],
        )?;
    }
    Ok(())
}

fn see_clipped(cases: &mut Cases<'_>, norm: f64, limit: f64) -> anyhow::Result<()> {
    if norm > 8e37 * limit {
        return Ok(());
    }
    // As the step uses it.
    let factor = f64::from(clip_factor(norm, limit) as f32);
    let is_whole = norm + 1e-6 <= limit;
    let error = match factor {
        0.0..=1.0 if factor == 1.0 || !is_whole => (factor * norm / limit - 1.0).max(0.0),
        _ => f64::NAN,
    };
    let extreme = "norms 0 to 3.4e38 and drawn, limits 1e-6 to 1e15";
    Ok(cases.see(
        extreme,
        format_args!("norm {norm:e}, limit {limit:e}"),
        [error],
    )?)
}

pub(crate) fn clipping(cases: &mut Cases<'_>) -> anyhow::Result<()> {
    let norms = [
        0.0, 1e-45, 1e-7, 1e-6, 1e-5, 1.0, 9.999, 10.0, 10.001, 1e15, 1e30, 3.4e38,
    ];
    for limit in [1e-6, 1e-3, 1.0, 10.0, 1e15] {
        for norm in norms {
            see_clipped(cases, norm, limit)?;
        }
    }
    for _ in cases.draws(5.0) {
        let limit = 10f64.powf(cases.rng.random_range(-6.0..=15.0));
        let norm = 10f64.powf(cases.rng.random_range(-45.0..=38.6));
        see_clipped(cases, norm, limit)?;
        let near = limit * (1.0 + cases.rng.random_range(-1e-6..1e-6));
        see_clipped(cases, near, limit)?;
    }
    Ok(())
}

/// A target network; in f64 its parameters, and how large they or the online network's ever were.
struct Followed {
    config: ModelConfig,
    target: Parameters,
    exact: Vec<(f64, f64)>,
}

impl Followed {
    fn new(config: ModelConfig, target: &[f32]) -> anyhow::Result<Self> {
        Ok(Self {
            target: small::parameters(&config, target)?,
            exact: target.iter().map(|&x| (x.into(), x.abs().into())).collect(),
            config,
        })
    }

    /// Moves so often towards these parameters.
    fn follow(&mut self, online: &[f32], tau: f64, moves: u64) -> anyhow::Result<()> {
        let source = small::parameters(&self.config, online)?;
        for _ in 0..moves {
            follow(&self.target, &source, tau, Kernels::FUSED)?;
        }
        // All moves at once: what is left of the distance is (1 - tau)^moves.
        let left = match tau {
            1.0 => 0.0,
            _ => (moves as f64 * (-tau).ln_1p()).exp(),
        };
        for ((exact, largest), &online) in self.exact.iter_mut().zip(online) {
            let online = f64::from(online);
            *exact = online + left * (*exact - online);
            *largest = largest.max(online.abs());
        }
        Ok(())
    }

    /// The largest error, as a share of what is promised.
    fn error(&self, tau: f64) -> anyhow::Result<f64> {
        let found = small::values(&self.config, &self.target)?;
        let each = found
            .iter()
            .zip(&self.exact)
            .map(|(&found, (exact, largest))| {
                let least = f64::from(f32::MIN_POSITIVE);
                (f64::from(found) - exact).abs() / largest.max(least) / follow_error(tau)
            });
        Ok(worst(each))
    }
}

pub(crate) fn target(cases: &mut Cases<'_>) -> anyhow::Result<()> {
    let len = small::len(&small::least());
    let start = [-0.4, -1.1, 0.6, 2.6, 0.0, 1e-45, -1e30, 1.0, 0.3, -0.3];
    let end = [0.7, -1.3, 0.011, 2.5, 1e-38, 1e-40, 1e30, -1.0, 1e-20, 7e6];
    let repeated = |values: [f32; 10]| -> Vec<f32> { (0..len).map(|i| values[i % 10]).collect() };
    for tau in [0.95, 0.5, 0.005, 1e-3, 1e-4, 1e-5] {
        let moves = (3.0 / tau) as u64;
        if moves > cases.settings.follow_moves {
            continue;
        }
        let mut network = Followed::new(small::least(), &repeated(start))?;
        network.follow(&repeated(end), tau, moves)?;
        let extreme = "3 / tau moves towards a network that stands still; tau 0.95, 0.5, 0.005, 1e-3, 1e-4, 1e-5";
        let input = format_args!("tau {tau}, {moves} moves");
        cases.see(extreme, input, [network.error(tau)?])?;
    }
    for _ in cases.draws(0.02) {
        let rng = &mut cases.rng;
        let start = clamped(len, FOLLOWED_MAX, rng);
        let mut network = Followed::new(small::least(), &start)?;
        let tau = 10f64.powf(rng.random_range(-5.0..0.0));
        for _ in 0..rng.random_range(1..8) {
            let moves = rng.random_range(1..5);
            network.follow(&clamped(len, FOLLOWED_MAX, rng), tau, moves)?;
        }
        let online = finites(len, rng);
        let extreme = "drawn, up to 30 moves towards a network that moves";
        let input = format_args!("tau {tau:e}, from {}", Shown(&start));
        cases.see(extreme, input, [network.error(tau)?])?;
        network.follow(&online, 1.0, 1)?;
        let found = small::values(&network.config, &network.target)?;
        for (found, online) in found.iter().zip(&online) {
            let is_copied = broken(found.to_bits() == online.to_bits());
            cases.see(
                "tau 1, drawn",
                format_args!("{online:e}"),
                [None, Some(is_copied)],
            )?;
        }
    }
    Ok(())
}
