//! The closed forms of the random walk of Fig. 1.

use std::f64::consts::PI;

use rand::Rng;

use crate::{
    stability::{
        check::{Context, Routine, Row},
        edges::exact_sum,
        routines::losses::worse,
    },
    studies::random_walk::chain::{Chain, GAP_ERROR, LAW_ERROR, MUTUAL_INFORMATION_ERROR},
};

const WALK: Routine = Routine {
    name: "random walk",
    range: "closed forms; alpha 0 to 1; 2 to 1e6 states, for the gap to 1e8",
};

/// The law, each state's weight by itself over their sum, and ln of the law.
fn law(states: usize, alpha: f64) -> (Vec<f64>, Vec<f64>) {
    // Exactly representable odds give an exact difference 1 - 2 alpha, from which ln(alpha / (1 - alpha)) keeps its digits.
    let tilt = 2.0 * alpha - 1.0;
    let log_odds = 2.0 * tilt.atanh();
    // Weights from the likelier end, so that none is above 1.
    let away = |i: usize| if log_odds > 0.0 { states - 1 - i } else { i } as f64;
    let log_weight = |i: usize| match away(i) {
        0.0 => 0.0,
        away => -away * log_odds.abs(),
    };
    let sum = exact_sum((0..states).map(|i| log_weight(i).exp()));
    let logs: Vec<f64> = (0..states).map(|i| log_weight(i) - sum.ln()).collect();
    (
        (0..states).map(|i| log_weight(i).exp() / sum).collect(),
        logs,
    )
}

/// -sum p ln p.
fn entropy(law: &[f64], logs: &[f64]) -> f64 {
    -exact_sum(
        law.iter()
            .zip(logs)
            .filter(|(p, _)| **p > 0.0)
            .map(|(p, log)| p * log),
    )
}

/// 1 - 2 sqrt(alpha (1 - alpha)) cos(pi / K) as (1 - s) + s (1 - cos), each without cancelling: 1 - s = tilt^2 / (1 + s), and 1 -
/// cos from its series.
fn gap(states: usize, alpha: f64) -> f64 {
    let tilt = 2.0 * alpha - 1.0;
    let s = 2.0 * (alpha * (1.0 - alpha)).sqrt();
    let x = PI / states as f64;
    let (mut term, mut versine) = (x * x / 2.0, 0.0);
    for n in 1..40 {
        versine += term;
        term *= -x * x / f64::from((2 * n + 1) * (2 * n + 2));
    }
    tilt * tilt / (1.0 + s) + s * versine
}

struct Rows {
    law: Row,
    information: Row,
    gap: Row,
}

impl Rows {
    fn new(extreme: &str) -> Self {
        let row = |promise: &str, bound: f64| Row::new(WALK, extreme, promise, bound);
        Self {
            law: row("error of a state's probability", LAW_ERROR),
            information: row(
                "error of the mutual information, nats",
                MUTUAL_INFORMATION_ERROR,
            ),
            gap: row("error of the spectral gap, as a share of it", GAP_ERROR),
        }
    }

    fn see(&mut self, states: usize, alpha: f64) {
        let chain = Chain { states, alpha };
        let input = || format!("{states} states, alpha {alpha:e}");
        self.gap
            .see(chain.spectral_gap() / gap(states, alpha) - 1.0, input);
        if states > 1_000_000 {
            return;
        }
        let (expected, logs) = law(states, alpha);
        let errors = chain.stationary().into_iter().zip(&expected);
        let errors = errors.map(|(found, expected)| (found - expected).abs());
        self.law.see(errors.fold(0.0, worse), input);
        let step = [alpha, 1.0 - alpha];
        let expected = entropy(&expected, &logs) - entropy(&step, &step.map(f64::ln));
        self.information
            .see(chain.mutual_information() - expected, input);
    }

    fn all(self) -> [Row; 3] {
        [self.law, self.information, self.gap]
    }
}

pub(super) fn check(context: &mut Context<'_>) -> anyhow::Result<Vec<Row>> {
    let mut listed = Rows::new(
        "2 to 1e6 states (gap: 1e8); alpha 0, 1e-300, 0.1, 0.499, 0.5 - 2.4e-7, 0.5, 0.5 + 1e-12, 0.9, 1",
    );
    let alphas = [
        0.0,
        1e-300,
        1e-9,
        0.1,
        0.3,
        0.499,
        0.5 - 2.4e-7,
        0.5,
        0.5 + 1e-12,
        0.7,
        0.9,
        1.0 - 1e-9,
        1.0,
    ];
    for states in [2, 3, 10, 324, 1000, 100_000, 1_000_000, 100_000_000] {
        for alpha in alphas {
            listed.see(states, alpha);
        }
        context.progress.advance(0)?;
    }
    let mut drawn = Rows::new("drawn");
    context.draw(0.05, |_, rng| {
        let states = 10f64.powf(rng.random_range(0.4..4.0)) as usize;
        let near = 10f64.powf(rng.random_range(-16.0..-0.4));
        let alpha = match rng.random_range(0..4) {
            0 => rng.random(),
            1 => near,
            2 => 0.5 + near,
            _ => 0.5 - near,
        };
        drawn.see(states, alpha);
        Ok(())
    })?;
    Ok(listed.all().into_iter().chain(drawn.all()).collect())
}
