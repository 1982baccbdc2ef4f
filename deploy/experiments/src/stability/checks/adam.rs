//! Adam: steps with any gradients, runs of many steps, and the bias correction at any step number.

use driml_learner::{
    AdamSettings,
    optimiser::adam::{STEP_ERROR, StepCoefficients, moment_error, step_floor},
};

use crate::stability::property::*;

/// The settings of `driml-ada` on Procgen, but with the eps that has the worst rounding errors.
const PRESET: AdamSettings = AdamSettings {
    lr: 2.5e-4,
    beta1: 0.9,
    beta2: 0.999,
    eps: 1e-8,
};
/// The largest `max_grad_norm`.
const GRADIENT_MAX: f32 = 1e15;
/// The error of a step that follows from the errors of the moments. The square root halves the relative error of the second moment.
const MOMENTS_ERROR: f64 = moment_error(PRESET.beta1) + moment_error(PRESET.beta2) / 2.0;
/// The inputs. Errors are shares of a parameter's way, the sum of its step sizes, beyond half of its last place for each step.
const RANGE: &str = "gradients within 1e15; lr 1e-30 to 1e33, beta 0 to 0.99999, eps 1e-15 to 1e30";
const OF_WAY: &str = "a parameter, as a share of its way";

const EQUAL: &str = "up to 120 equal gradients of 0, 1e-45, 1e-38, 1e-19, 1, 1e15; eps 1e-15, 1e-8, 1, 1e30; beta 0, 0.9, 0.99999";
const DRAWN: &str = "drawn, up to 120 gradients";
const NUMBERS: &str = "step number 1, 2, 1000, 2^24, 2^31, 2^32, 2^33, 2^53, 2^64, and each less 1";

pub(super) fn properties(settings: &Settings) -> Vec<Property> {
    let steps = settings.adam_steps;
    let long = format!("{steps} steps of eight patterns of gradients, 1e-40 to 1e15");
    vec![
        Property::new("Adam", RANGE)
            // The first promise is for second moments well within f32, the second for those near its smallest numbers.
            .promise(OF_WAY, STEP_ERROR / 10.0)
            .promise("the same at the least second moments", STEP_ERROR)
            .check(EQUAL, Listed, |cases| few_steps(cases, 0))
            .check(DRAWN, Drawn(0.5), |cases| few_steps(cases, 1)),
        Property::new("Adam", RANGE)
            .promise(OF_WAY, MOMENTS_ERROR)
            // This counts only if `step_floor`, summed over the steps, is at most `STEP_ERROR` of the way.
            .promise("a parameter, all in", 2.0 * STEP_ERROR)
            // The error is relative to the decayed mean of |gradient|, for patterns that never end.
            .promise("the first moment", moment_error(PRESET.beta1))
            .promise("the second moment", moment_error(PRESET.beta2))
            .check(&long, Listed, long_run),
        Property::new("Adam", RANGE)
            .promise(OF_WAY, F32_STEP)
            .check(NUMBERS, Listed, step_number),
    ]
}

/// A parameter that starts at 0, and its moments: in f32 as [`StepCoefficients`] steps them, and in f64.
#[derive(Clone, Copy, Default)]
struct TrackedParameter {
    /// The parameter and its moments in f32.
    found: [f32; 3],
    p: f64,
    m: f64,
    v: f64,
    /// The sum of the sizes of all steps.
    path_length: f64,
    /// The error allowed for f32: the sum of [`step_floor`] over the steps; NaN after a step that is not finite.
    floor: f64,
    /// The decayed mean of |gradient|.
    size: f64,
}

impl TrackedParameter {
    /// Returns the error of the parameter beyond `floor`, as a share of its way.
    fn error(&self) -> f64 {
        match (f64::from(self.found[0]) - self.p).abs() - self.floor {
            error if error <= 0.0 => 0.0,
            error => error / self.path_length,
        }
    }
}

/// Makes step number `t` for each parameter with its gradient.
fn step(settings: AdamSettings, t: u64, all: &mut [TrackedParameter], gradients: &[f32]) {
    let coefficients = StepCoefficients::new(settings, t, 1.0);
    let (lr, eps) = (settings.lr, settings.eps);
    let (beta1, beta2) = (settings.beta1, settings.beta2);
    // 1 - beta^t, computed without cancellation near beta = 1 and near t = 0.
    let [first, second] = [beta1, beta2].map(|beta| -(t as f64 * beta.ln()).exp_m1());
    // All of them step together, like the parameters of a tensor.
    let [mut p, mut m, mut v] =
        [0, 1, 2].map(|i| all.iter().map(|it| it.found[i]).collect::<Vec<_>>());
    let is_finite = coefficients.apply(&mut p, gradients, &mut m, &mut v);
    for (i, (it, &g)) in all.iter_mut().zip(gradients).enumerate() {
        it.found = [p[i], m[i], v[i]];
        let g = f64::from(g);
        it.m = beta1 * it.m + (1.0 - beta1) * g;
        it.v = beta2 * it.v + (1.0 - beta2) * g * g;
        it.size = beta1 * it.size + (1.0 - beta1) * g.abs();
        let step = lr * (it.m / first) / ((it.v / second).sqrt() + eps);
        it.p -= step;
        it.path_length += step.abs();
        let floor = step_floor(it.p.abs().max(step.abs()), eps);
        it.floor += nan_unless(is_finite, floor);
    }
}

/// The (beta1, beta2) with which drawn gradients are tried.
const DRAWN_BETAS: [(f64, f64); 5] = [
    (0.0, 0.0),
    (0.0, 0.9),
    (0.9, 0.99),
    (0.9, 0.999),
    (0.5, 0.99999),
];

/// Makes up to 120 steps from 0. The error counts for `promise`.
fn few_steps(cases: &mut Cases<'_>, promise: usize) -> anyhow::Result<()> {
    let betas = [(0.0, 0.0), (0.9, 0.999), (0.99999, 0.99999), (0.0, 0.99999)];
    let (beta1, beta2) = cases.listed_or(&betas, |rng| one_of(&DRAWN_BETAS, rng));
    let lrs = [1e-30, 2.5e-4, 1.0];
    let lr = cases.listed_or(&lrs, |rng| one_of(&[1e-30, 1e-4, 1.0], rng));
    let all_eps = [1e-15, 1e-8, 1.0, 1e30];
    let eps = cases.listed_or(&all_eps, |rng| {
        one_of(&[1e-15, 1e-8, 3.9e-5, 1.0, 1e30], rng)
    });
    let equal = [0.0, 1e-45, 1e-38, 1e-19, 1e-8, 1.0, 1e15].map(|g| [vec![g], vec![g; 120]]);
    let gradients = cases.listed_or(&equal.concat(), |rng| {
        draw_clamped(rng.random_range(1..120), GRADIENT_MAX, rng)
    });
    let settings = AdamSettings {
        lr,
        beta1,
        beta2,
        eps,
    };
    let mut one = [TrackedParameter::default()];
    for (t, &g) in (1..).zip(&gradients) {
        step(settings, t, &mut one, &[g]);
    }
    let mut errors = [None; 2];
    errors[promise] = Some(one[0].error());
    let input = format_args!("{settings:?}, gradients {}", Preview(&gradients));
    cases.record_errors(input, errors)
}

/// A name, and a function of the step number and noise in -1..1 that gives the gradient.
type Pattern = (&'static str, fn(u64, f32) -> f32);

/// Patterns of gradients. The promises about moments hold for the first three, which never end.
const PATTERNS: [Pattern; 8] = [
    ("0.02 for ever", |_, _| 0.02),
    ("+-1e-5 in turn", |t, _| 1e-5 * alternating_sign(t)),
    ("noise", |_, noise| noise * 1e-3),
    ("one of 1 in a thousand, else 1e-6", |t, _| match t % 1000 {
        0 => 1.0,
        _ => 1e-6,
    }),
    ("falling to 0 within 1e5 steps", |t, _| {
        (-(t as f32) / 1000.0).exp()
    }),
    ("1e-20 for ever", |_, _| 1e-20),
    ("+-1e15 in turn", |t, _| 1e15 * alternating_sign(t)),
    ("subnormal, 1e-40", |_, _| 1e-40),
];

const fn alternating_sign(t: u64) -> f32 {
    if t.is_multiple_of(2) { 1.0 } else { -1.0 }
}

fn long_run(cases: &mut Cases<'_>) -> anyhow::Result<()> {
    let steps = cases.settings.adam_steps;
    let mut all = [TrackedParameter::default(); PATTERNS.len()];
    let mut next_check = 10;
    for t in 1..=steps {
        let noise = cases.rng.random_range(-1.0f32..1.0);
        let gradients = PATTERNS.map(|(_, gradient)| gradient(t, noise));
        step(PRESET, t, &mut all, &gradients);
        if t == next_check || t == steps {
            next_check *= 10;
            for (at, it) in all.iter().enumerate() {
                let [p, m, v] = it.found.map(f64::from);
                let is_well_scaled = it.floor <= STEP_ERROR * it.path_length;
                let errors = [
                    Some(it.error()),
                    is_well_scaled.then_some((p - it.p) / it.path_length),
                    (at < 3).then_some((m - it.m) / it.size),
                    (at < 3).then_some((v - it.v) / it.v),
                ];
                let input = format_args!("{}, after {t} steps", PATTERNS[at].0);
                cases.record_errors(input, errors)?;
            }
        }
        if t.is_multiple_of(100_000) {
            cases.check_interrupt()?;
        }
    }
    Ok(())
}

/// Checks a single step at numbers up to the largest u64.
fn step_number(cases: &mut Cases<'_>) -> anyhow::Result<()> {
    let powers = [24, 31, 32, 33, 53].map(|power| 1 << power);
    let number = cases.one_of(&[&[1, 2, 1000, u64::MAX][..], &powers].concat());
    let t = cases.one_of(&[(number - 1).max(1), number]);
    let beta2 = cases.one_of(&[0.9, 0.999, 0.99999]);
    let mut one = [TrackedParameter {
        found: [0.0, 0.25, 0.5],
        m: 0.25,
        v: 0.5,
        ..TrackedParameter::default()
    }];
    step(AdamSettings { beta2, ..PRESET }, t, &mut one, &[0.125]);
    cases.record_errors(format_args!("step {t}, beta2 {beta2}"), [one[0].error()])
}
