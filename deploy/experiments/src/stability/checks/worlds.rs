//! The closed forms of the random walk of Fig. 1.

use std::f64::consts::PI;

use rand::Rng;

use crate::{
    stability::{
        edges::{exact_sum, worst},
        property::{Cases, Drawn, Listed, Property},
    },
    studies::random_walk::chain::{Chain, GAP_ERROR, LAW_ERROR, MUTUAL_INFORMATION_ERROR},
};

const WALKS: &str = "2 to 1e6 states (gap: 1e8); alpha 0, 1e-300, 0.1, 0.499, 0.5 - 2.4e-7, 0.5, 0.5 + 1e-12, 0.9, 1";

pub(super) const PROPERTIES: &[Property] = &[
    Property {
        routine: "random walk",
        range: "closed forms; alpha 0 to 1; 2 to 1e6 states, for the gap to 1e8",
        promises: &[
            ("a state's probability", LAW_ERROR),
            ("mutual information, nats", MUTUAL_INFORMATION_ERROR),
            ("spectral gap, as a share of it", GAP_ERROR),
        ],
        extremes: &[(WALKS, Listed, walk), ("drawn", Drawn(0.05), walk)],
    },
];

/// The law and ln of it: each state's weight by itself over their sum.
fn law_of_walk(states: usize, alpha: f64) -> (Vec<f64>, Vec<f64>) {
    // Exactly representable odds give an exact difference 1 - 2 alpha, from which ln(alpha / (1 - alpha)) keeps its digits.
    let log_odds = 2.0 * (2.0 * alpha - 1.0).atanh();
    // Weights from the likelier end, so that none is above 1.
    let log_weight = |i: usize| match if log_odds > 0.0 { states - 1 - i } else { i } {
        0 => 0.0,
        away => -(away as f64) * log_odds.abs(),
    };
    let sum = exact_sum((0..states).map(|i| log_weight(i).exp()));
    let law = (0..states).map(|i| log_weight(i).exp() / sum);
    (
        law.collect(),
        (0..states).map(|i| log_weight(i) - sum.ln()).collect(),
    )
}

/// -sum p ln p.
fn entropy(law: &[f64], logs: &[f64]) -> f64 {
    let there = law.iter().zip(logs).filter(|(p, _)| **p > 0.0);
    -exact_sum(there.map(|(p, log)| p * log))
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

fn walk(cases: &mut Cases<'_>) -> anyhow::Result<()> {
    let listed = [2, 3, 10, 324, 1000, 100_000, 1_000_000, 100_000_000];
    let states = cases.of(&listed, |rng| {
        10f64.powf(rng.random_range(0.4..4.0)) as usize
    });
    let listed = [
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
    let alpha = cases.of(&listed, |rng| {
        let near = 10f64.powf(rng.random_range(-16.0..-0.4));
        match rng.random_range(0..4) {
            0 => rng.random(),
            1 => near,
            2 => 0.5 + near,
            _ => 0.5 - near,
        }
    });
    let chain = Chain { states, alpha };
    let input = format_args!("{states} states, alpha {alpha:e}");
    if states <= 1_000_000 {
        let (law, logs) = law_of_walk(states, alpha);
        let found = chain.stationary().into_iter().zip(&law);
        let of_law = worst(found.map(|(found, expected)| (found - expected).abs()));
        let step = [alpha, 1.0 - alpha];
        let information = entropy(&law, &logs) - entropy(&step, &step.map(f64::ln));
        cases.see(input, [of_law, chain.mutual_information() - information])?;
    }
    let of_gap = chain.spectral_gap() / gap(states, alpha) - 1.0;
    cases.see(input, [None, None, Some(of_gap)])
}
