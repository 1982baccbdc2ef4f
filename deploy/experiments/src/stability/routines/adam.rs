//! Adam: steps of any gradients, ten million of them, and the bias correction of any step number.

use driml_learner::{
    AdamSettings, Kernels,
    optimiser::adam::{Adam, Rule, STEP_ERROR, moment_error, step_floor},
};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::gradients::gradients;
use crate::stability::{
    check::{Context, Routine, Row},
    edges::{finites, shown},
    small,
};

const ADAM: Routine = Routine {
    name: "Adam",
    range: "gradients within 1e15; lr 1e-30 to 1e38, beta 0 to 0.99999, eps 1e-15 to 1e30",
};
/// As `driml-ada` on Procgen has them, but for the eps, which here is the one that rounds worst.
const PRESET: AdamSettings = AdamSettings {
    lr: 2.5e-4,
    beta1: 0.9,
    beta2: 0.999,
    eps: 1e-8,
};

/// One parameter and its moments in float64.
#[derive(Clone, Default)]
struct Exact {
    p: f64,
    m: f64,
    v: f64,
    /// How far the parameter went, back and forth.
    way: f64,
    /// What f32 may add: [`step_floor`] of each step.
    floor: f64,
    /// Decayed mean of the gradients' sizes.
    size: f64,
}

/// 1 - beta^t, which keeps its digits near beta = 1 and near t = 0.
fn rest(beta: f64, t: f64) -> f64 {
    if beta == 0.0 {
        1.0
    } else {
        -(t * beta.ln()).exp_m1()
    }
}

/// What is the same for every parameter of a step.
struct Corrections {
    settings: AdamSettings,
    first: f64,
    second: f64,
}

impl Corrections {
    fn new(settings: AdamSettings, step: u64) -> Self {
        let t = step as f64;
        Self {
            settings,
            first: rest(settings.beta1, t),
            second: rest(settings.beta2, t),
        }
    }
}

impl Exact {
    fn step(&mut self, with: &Corrections, g: f64) {
        let AdamSettings {
            lr,
            beta1,
            beta2,
            eps,
        } = with.settings;
        self.m = beta1 * self.m + (1.0 - beta1) * g;
        self.v = beta2 * self.v + (1.0 - beta2) * g * g;
        self.size = beta1 * self.size + (1.0 - beta1) * g.abs();
        let step = lr * (self.m / with.first) / ((self.v / with.second).sqrt() + eps);
        self.p -= step;
        self.way += step.abs();
        self.floor += step_floor(self.p.abs().max(step.abs()), eps);
    }

    /// The error of a parameter as a share of its way, [`step_floor`] apart.
    fn error(&self, p: f32) -> f64 {
        let error = (f64::from(p) - self.p).abs() - self.floor;
        if error <= 0.0 { 0.0 } else { error / self.way }
    }
}

fn row(extreme: &str, bound: f64) -> Row {
    Row::new(
        ADAM,
        extreme,
        "error of a parameter, as a share of the way it went, beside half of its last place a step",
        bound,
    )
}

/// One sequence of gradients for one parameter that starts at 0.
fn see_sequence(row: &mut Row, settings: AdamSettings, gradients: &[f32]) {
    let (mut p, mut m, mut v) = ([0f32], [0f32], [0f32]);
    let mut exact = Exact::default();
    let mut finite = true;
    for (step, &g) in (1..).zip(gradients) {
        finite &= Rule::new(settings, step, 1.0).apply(&mut p, &[g], &mut m, &mut v);
        exact.step(&Corrections::new(settings, step), g.into());
    }
    let error = if finite { exact.error(p[0]) } else { f64::MAX };
    row.see(error, || {
        format!("{settings:?}, gradients {}", shown(gradients))
    });
}

pub(super) fn check(context: &mut Context<'_>) -> anyhow::Result<Vec<Row>> {
    let mut listed = row(
        "up to 120 equal gradients of 0, 1e-45, 1e-38, 1e-19, 1, 1e15; eps 1e-15, 1e-8, 1, 1e30; beta 0, 0.9, 0.99999",
        // Second moments near the least that f32 holds, where a step may lose STEP_ERROR, are drawn below.
        STEP_ERROR / 10.0,
    );
    for (beta1, beta2) in [(0.0, 0.0), (0.9, 0.999), (0.99999, 0.99999), (0.0, 0.99999)] {
        for eps in [1e-15, 1e-8, 1.0, 1e30] {
            for lr in [1e-30, 2.5e-4, 1.0] {
                for g in [0.0, 1e-45, 1e-38, 1e-19, 1e-8, 1.0, 1e15] {
                    let settings = AdamSettings {
                        lr,
                        beta1,
                        beta2,
                        eps,
                    };
                    for count in [1, 120] {
                        see_sequence(&mut listed, settings, &vec![g; count]);
                    }
                }
            }
        }
    }
    let mut drawn = row("drawn, up to 120 gradients", STEP_ERROR);
    context.draw(0.5, |_, rng| {
        let betas = [
            (0.0, 0.0),
            (0.0, 0.9),
            (0.9, 0.99),
            (0.9, 0.999),
            (0.5, 0.99999),
        ];
        let (beta1, beta2) = betas[rng.random_range(0..betas.len())];
        let settings = AdamSettings {
            lr: [1e-30, 1e-4, 1.0][rng.random_range(0..3)],
            beta1,
            beta2,
            eps: [1e-15, 1e-8, 3.9e-5, 1.0, 1e30][rng.random_range(0..5)],
        };
        let count = rng.random_range(1..120);
        let mut gradients = finites(count, rng);
        gradients.iter_mut().for_each(|g| *g = g.clamp(-1e15, 1e15));
        see_sequence(&mut drawn, settings, &gradients);
        Ok(())
    })?;
    let mut rows = vec![listed, drawn];
    rows.extend(long_run(context)?);
    rows.extend([any_step_number(), dead(), through_tensors(context)?]);
    Ok(rows)
}

const PATTERNS: [&str; 8] = [
    "0.02 for ever",
    "+-1e-5 in turn",
    "noise",
    "one of 1 in a thousand, else 1e-6",
    "falling to 0 within 1e5 steps",
    "1e-20 for ever",
    "+-1e15 in turn",
    "subnormal, 1e-40",
];
/// Patterns whose gradients go on, of which the moments promise something.
const GOING_ON: [usize; 3] = [0, 1, 2];

fn pattern(which: usize, t: u64, noise: f32) -> f32 {
    let turn = if t.is_multiple_of(2) { 1.0 } else { -1.0 };
    match which {
        0 => 0.02,
        1 => 1e-5 * turn,
        2 => noise * 1e-3,
        3 if t.is_multiple_of(1000) => 1.0,
        3 => 1e-6,
        4 => (-(t as f32) / 1000.0).exp(),
        5 => 1e-20,
        6 => 1e15 * turn,
        _ => 1e-40,
    }
}

fn long_run(context: &mut Context<'_>) -> anyhow::Result<Vec<Row>> {
    let steps = context.settings.adam_steps;
    let title = format!("{steps} steps");
    // The root halves the share that the second moment is off by.
    let of_moments = moment_error(PRESET.beta1) + moment_error(PRESET.beta2) / 2.0;
    let mut parameter = Row::new(
        ADAM,
        &format!("{title} of eight patterns of gradients, 1e-40 to 1e15"),
        "error of a parameter, as a share of the way it went, beside half of its last place a step, which most errors stay within: what the errors of the moments, below, allow",
        of_moments,
    );
    let mut small = Row::new(
        ADAM,
        &format!("{title}, where half of a parameter's last place is below 0.4% of a step"),
        "error of a parameter, all in, as a share of the way it went",
        2.0 * STEP_ERROR,
    );
    let mut moments = [("first", PRESET.beta1), ("second", PRESET.beta2)].map(|(which, beta)| {
        Row::new(
            ADAM,
            &format!("{title}, gradients that go on"),
            &format!("error of the {which} moment, as a share of the decayed mean of sizes"),
            moment_error(beta),
        )
    });
    let mut rng = ChaCha8Rng::seed_from_u64(context.rng.random());
    let (mut p, mut m, mut v) = ([0f32; 8], [0f32; 8], [0f32; 8]);
    let mut exact: [Exact; 8] = Default::default();
    let mut next_look = 10;
    for t in 1..=steps {
        let noise = rng.random_range(-1.0f32..1.0);
        let g: [f32; 8] = std::array::from_fn(|which| pattern(which, t, noise));
        let finite = Rule::new(PRESET, t, 1.0).apply(&mut p, &g, &mut m, &mut v);
        let corrections = Corrections::new(PRESET, t);
        for (exact, g) in exact.iter_mut().zip(g) {
            exact.step(&corrections, g.into());
        }
        if t == next_look || t == steps {
            next_look *= 10;
            for (which, exact) in exact.iter().enumerate() {
                let input = || format!("{}, after {t} steps", PATTERNS[which]);
                parameter.see(
                    if finite {
                        exact.error(p[which])
                    } else {
                        f64::MAX
                    },
                    input,
                );
                if exact.floor <= STEP_ERROR * exact.way {
                    small.see((f64::from(p[which]) - exact.p) / exact.way, input);
                }
                if GOING_ON.contains(&which) {
                    moments[0].see((f64::from(m[which]) - exact.m) / exact.size, input);
                    moments[1].see((f64::from(v[which]) - exact.v) / exact.v, input);
                }
            }
        }
        if t.is_multiple_of(100_000) {
            context.progress.advance(0)?;
        }
    }
    let [first, second] = moments;
    Ok(vec![parameter, small, first, second])
}

/// A first step whose number is as large as numbers get.
fn any_step_number() -> Row {
    let mut row = row(
        "step number 1, 2, 1000, 2^24, 2^31, 2^32, 2^33, 2^53, 2^64, each less 1 and as it is",
        f32::EPSILON.into(),
    );
    let numbers = [
        1u64,
        2,
        1000,
        1 << 24,
        1 << 31,
        1 << 32,
        1 << 33,
        1 << 53,
        u64::MAX,
    ];
    for number in numbers {
        for step in [(number - 1).max(1), number] {
            for beta2 in [0.9, 0.999, 0.99999] {
                let settings = AdamSettings { beta2, ..PRESET };
                let (mut p, mut m, mut v) = ([0f32], [0.25f32], [0.5f32]);
                let finite = Rule::new(settings, step, 1.0).apply(&mut p, &[0.125], &mut m, &mut v);
                let mut exact = Exact {
                    m: 0.25,
                    v: 0.5,
                    ..Exact::default()
                };
                exact.step(&Corrections::new(settings, step), 0.125);
                let error = if finite { exact.error(p[0]) } else { f64::MAX };
                row.see(error, || format!("step {step}, beta2 {beta2}"));
            }
        }
    }
    row
}

/// A gradient that is gone leaves nothing that slows the steps.
fn dead() -> Row {
    let mut row = Row::new(
        ADAM,
        "a gradient that is gone, 100,000 steps later",
        "moments that are not 0",
        0.0,
    );
    for g in [1e-30f32, 1e-3, 1.0, 1e15] {
        let (mut p, mut m, mut v) = ([1f32], [0f32], [0f32]);
        // The second moment of the largest begins 1e36 above 1, and falls by a factor of e in a thousand steps.
        let steps = if g > 1.0 { 250_000 } else { 100_000 };
        for t in 1..=steps {
            let g = if t <= 10 { g } else { 0.0 };
            Rule::new(PRESET, t, 1.0).apply(&mut p, &[g], &mut m, &mut v);
        }
        row.must(m == [0.0] && v == [0.0], || {
            format!("gradient {g:e}: {m:?}, {v:?}")
        });
    }
    row
}

/// The optimiser as the learner calls it, on tensors, gives the bits of the rule.
fn through_tensors(context: &mut Context<'_>) -> anyhow::Result<Row> {
    let mut row = Row::new(
        ADAM,
        "all parameters of a network, as the learner steps them",
        "parameters whose bits differ from those of the rule above",
        0.0,
    );
    let config = small::config(5, 7, (-1.0, 1.0));
    let len = small::len(&config);
    let mut p = vec![0.5f32; len];
    let (mut m, mut v) = (vec![0f32; len], vec![0f32; len]);
    let parameters = small::parameters(&config, &p)?;
    let mut adam = Adam::new(PRESET, &parameters, Kernels::FUSED)?;
    for step in 1..=100 {
        let mut g = finites(len, &mut context.rng);
        g.iter_mut().for_each(|g| *g = g.clamp(-1e15, 1e15));
        adam.step(&parameters, &gradients(&config, &g)?, 0.5)?;
        Rule::new(PRESET, step, 0.5).apply(&mut p, &g, &mut m, &mut v);
        let found = small::values(&config, &parameters)?;
        for (at, (found, expected)) in found.iter().zip(&p).enumerate() {
            row.must(found.to_bits() == expected.to_bits(), || {
                format!("step {step}, parameter {at}: {found:e}, {expected:e}")
            });
        }
    }
    Ok(row)
}
