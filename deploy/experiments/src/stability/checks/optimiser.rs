//! Around the optimiser: the norm of all gradients together, the factor that clips it, and the target network's moves.

use candle_core::{Device, Tensor};
use driml_learner::{
    Kernels,
    optimiser::{
        gradients::{Gradients, NORM_ERROR, clip_factor},
        target::{FOLLOWED_MAX, follow, follow_error},
    },
};
use driml_model::{ModelConfig, Parameters};

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
            .on(NORMS, Listed, norm)
            .on("drawn", Drawn(0.05), norm)
            .on("one is infinite or not a number", Drawn(0.05), norm_of_none),
        Property::new("clipping", limits)
            .promise("share by which a norm is above the limit", 6.1e-8)
            .on("norms 0 to 3.4e38, limits 1e-6 to 1e15", Listed, clipping)
            .on("drawn, half of them near the limit", Drawn(10.0), clipping),
        Property::new("target network", "tau 1e-5 to 1; parameters within 1.7e38")
            // Of the largest that either ever was.
            .promise("a parameter, as a share of `follow_error`", 1.0)
            .promise("copies of other bits", 0.0)
            .on(MOVES, Listed, followed_to_the_end)
            .on(A_FEW_MOVES, Drawn(0.02), followed)
            .on("tau 1, drawn", Drawn(0.02), copied),
    ]
}

/// Gradients with these values, one parameter after the other: those of the sum of each parameter times its value.
fn gradients(config: &ModelConfig, values: &[f32]) -> anyhow::Result<Gradients> {
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

fn norm(cases: &mut Cases<'_>) -> anyhow::Result<()> {
    let sizes = cases.of(&[(2, 1), (512, 256)], |_| (17, 13));
    let config = small::config(sizes.0, sizes.1, (-1.0, 1.0));
    let len = small::len(&config);
    let values = cases.of(&listed(len), |rng| finites(len, rng));
    let norm = gradients(&config, &values)?.norm(Kernels::FUSED)?;
    // The largest value's size times the norm of the shares of it.
    let largest = f64::from(values.iter().fold(0.0f32, |most, x| most.max(x.abs())));
    let squares = values.iter().map(|x| (f64::from(*x) / largest).powi(2));
    let error = match largest {
        0.0 => norm,
        _ => norm / (largest * exact_sum(squares).sqrt()) - 1.0,
    };
    cases.see(format_args!("{}", Shown(&values)), [error])
}

fn norm_of_none(cases: &mut Cases<'_>) -> anyhow::Result<()> {
    let config = small::config(17, 13, (-1.0, 1.0));
    let mut values = finites(small::len(&config), &mut cases.rng);
    let at = cases.rng.random_range(0..values.len());
    values[at] = not_finite(&mut cases.rng);
    let said = gradients(&config, &values)?.norm(Kernels::FUSED);
    let said = said.map_or_else(|e| e.to_string(), |norm| format!("a norm of {norm}"));
    let by_name = said.starts_with("the gradient of ") && said.contains(" is not finite");
    cases.keeps(1, format_args!("{said}"), by_name)
}

fn clipping(cases: &mut Cases<'_>) -> anyhow::Result<()> {
    let limits = [1e-6, 1e-3, 1.0, 10.0, 1e15];
    let limit: f64 = cases.of(&limits, |rng| 10f64.powf(rng.random_range(-6.0..=15.0)));
    let norms = [
        0.0, 1e-45, 1e-7, 1e-6, 1e-5, 1.0, 9.999, 10.0, 10.001, 1e15, 1e30, 3.4e38,
    ];
    let norm = cases.of(&norms, |rng| match rng.random_bool(0.5) {
        true => 10f64.powf(rng.random_range(-45.0..=38.6)),
        false => limit * (1.0 + rng.random_range(-1e-6..1e-6)),
    });
    if norm <= 8e37 * limit {
        // As the step uses it.
        let factor = f64::from(clip_factor(norm, limit) as f32);
        let is_right = factor == 1.0 || (norm + 1e-6 > limit && (0.0..1.0).contains(&factor));
        let error = only_if(is_right, (factor * norm / limit - 1.0).max(0.0));
        cases.see(format_args!("norm {norm:e}, limit {limit:e}"), [error])?;
    }
    Ok(())
}

/// A target network of the smallest kind; in f64 its parameters, and how large they or the online network's ever were.
struct Followed {
    target: Parameters,
    exact: Vec<(f64, f64)>,
}

impl Followed {
    /// A network of eight of these parameters.
    fn new(target: &[f32]) -> anyhow::Result<Self> {
        let exact = target.iter().map(|&x| (x.into(), x.abs().into()));
        Ok(Self {
            target: small::parameters(&small::least(), target)?,
            exact: exact.collect(),
        })
    }

    /// Moves so often towards these parameters.
    fn follow(&mut self, online: &[f32], tau: f64, moves: u64) -> anyhow::Result<()> {
        let source = small::parameters(&small::least(), online)?;
        for _ in 0..moves {
            follow(&self.target, &source, tau, Kernels::FUSED)?;
        }
        // All moves at once: what is left of the distance is (1 - tau)^moves.
        let left = (moves as f64 * (-tau).ln_1p()).exp();
        for ((exact, largest), online) in self.exact.iter_mut().zip(widened(online)) {
            *exact = online + left * (*exact - online);
            *largest = largest.max(online.abs());
        }
        Ok(())
    }

    /// The largest error, as a share of what is promised.
    fn error(&self, tau: f64) -> anyhow::Result<f64> {
        let found = small::values(&small::least(), &self.target)?;
        let errors = found
            .iter()
            .zip(&self.exact)
            .map(|(&found, (exact, largest))| {
                (f64::from(found) - exact).abs() / largest.max(LEAST) / follow_error(tau)
            });
        Ok(worst(errors))
    }
}

fn followed_to_the_end(cases: &mut Cases<'_>) -> anyhow::Result<()> {
    let tau = cases.each(&[0.95, 0.5, 0.005, 1e-3, 1e-4, 1e-5]);
    let moves = (3.0 / tau) as u64;
    let mut network = Followed::new(&[-0.4, -1.1, 0.6, 2.6, 0.0, 1e-45, -1e30, 1.0])?;
    let end = [0.7, -1.3, 0.011, 2.5, 1e-38, 1e-40, 1e30, -1.0];
    network.follow(&end, tau, moves)?;
    let input = format_args!("tau {tau}, {moves} moves");
    cases.see(input, [network.error(tau)?])
}

fn followed(cases: &mut Cases<'_>) -> anyhow::Result<()> {
    let rng = &mut cases.rng;
    let start = clamped(10, FOLLOWED_MAX, rng);
    let mut network = Followed::new(&start)?;
    let tau = 10f64.powf(rng.random_range(-5.0..0.0));
    for _ in 0..rng.random_range(1..8) {
        let moves = rng.random_range(1..5);
        network.follow(&clamped(10, FOLLOWED_MAX, rng), tau, moves)?;
    }
    let input = format_args!("tau {tau:e}, from {}", Shown(&start));
    cases.see(input, [network.error(tau)?])
}

fn copied(cases: &mut Cases<'_>) -> anyhow::Result<()> {
    let mut network = Followed::new(&finites(10, &mut cases.rng))?;
    let online = finites(8, &mut cases.rng);
    network.follow(&online, 1.0, 1)?;
    let found = small::values(&small::least(), &network.target)?;
    for (found, online) in found.iter().zip(&online) {
        let is_copied = found.to_bits() == online.to_bits();
        cases.keeps(1, format_args!("{online:e}"), is_copied)?;
    }
    Ok(())
}
