//! The closed forms of the random walk of Fig. 1; the Ising lattice's law at the ends of the temperatures, and its books.

use std::f64::consts::PI;

use driml_envs::{Boundary, IsingLattice};
use rand::Rng;

use super::sampling::{DEVIATIONS, deviations};
use crate::{
    stability::{
        edges::{exact_sum, worst},
        property::{Cases, Drawn, Listed, Property},
    },
    studies::random_walk::chain::{Chain, GAP_ERROR, LAW_ERROR, MUTUAL_INFORMATION_ERROR},
};

const WALKS: &str = "2 to 1e6 states (gap: 1e8); alpha 0, 1e-300, 0.1, 0.499, 0.5 - 2.4e-7, 0.5, 0.5 + 1e-12, 0.9, 1";
const LATTICES: &str = "3 x 3 periodic and 3 x 4 free, all states counted; T 2, 2.27, 4, 5";
const SWEEPS: &str = "T 1e-300 to 5, for the energy 1e-300, 1e-9, 0.02; 3 x 3 to 64 x 64";

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
    Property {
        routine: "Ising lattice",
        range: "temperatures above 0 and up to 5; sides up to 4,096",
        promises: &[
            ("chi-square of the energy, in deviations", DEVIATIONS),
            ("sweeps in which the energy rises", 0.0),
            ("sweeps whose books are not those of the spins", 0.0),
        ],
        extremes: &[(LATTICES, Listed, energies), (SWEEPS, Listed, books)],
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

/// Energy of spins [height, width], each bond once.
fn energy(spins: &[i8], height: usize, width: usize, boundary: Boundary) -> i64 {
    let at = |r: usize, c: usize| i64::from(spins[r % height * width + c % width]);
    let is_periodic = boundary == Boundary::Periodic;
    let mut energy = 0;
    for (r, c) in (0..height).flat_map(|r| (0..width).map(move |c| (r, c))) {
        if r + 1 < height || is_periodic {
            energy -= at(r, c) * at(r + 1, c);
        }
        if c + 1 < width || is_periodic {
            energy -= at(r, c) * at(r, c + 1);
        }
    }
    energy
}

/// P(E = least + i) over all states of a lattice of so few sites that all can be counted.
fn law_of_lattice(height: usize, width: usize, t: f64, boundary: Boundary) -> (i64, Vec<f64>) {
    let sites = height * width;
    let spin = |state: usize, i: usize| if state >> i & 1 == 1 { 1 } else { -1 };
    let energy = |state: usize| {
        let spins: Vec<i8> = (0..sites).map(|i| spin(state, i)).collect();
        energy(&spins, height, width, boundary)
    };
    let least = energy(0);
    let mut law = vec![0.0; (-2 * least + 1) as usize];
    for state in 0..1usize << sites {
        let above = energy(state) - least;
        law[above as usize] += (-(above as f64) / t).exp();
    }
    let sum: f64 = law.iter().sum();
    (least, law.into_iter().map(|p| p / sum).collect())
}

fn energies(cases: &mut Cases<'_>) -> anyhow::Result<()> {
    let samples = (cases.settings.law_draws / 8).max(2000);
    let lattices = [(3, 3, Boundary::Periodic), (3, 4, Boundary::Free)];
    let (height, width, boundary) = cases.each(&lattices);
    let t = cases.each(&[2.0, 2.269_185, 4.0, 5.0]);
    let rng = &mut cases.rng;
    let mut lattice = IsingLattice::random(height, width, t, boundary, rng)?;
    let (least, law) = law_of_lattice(height, width, t, boundary);
    let mut counts = vec![0u64; law.len()];
    for sample in 0..samples + 20 {
        // So far apart that energies hardly know of each other.
        (0..30).for_each(|_| lattice.sweep(rng));
        if sample >= 20 {
            counts[(lattice.energy() - least) as usize] += 1;
        }
    }
    let input = format_args!("{height} x {width}, {boundary:?}, T = {t}");
    cases.see(input, [deviations(&counts, &law)])
}

fn books(cases: &mut Cases<'_>) -> anyhow::Result<()> {
    let side = cases.each(&[3usize, 7, 64]);
    let t = cases.each(&[1e-300, 1e-9, 0.02, 0.4, 2.27, 5.0]);
    let boundary = cases.each(&[Boundary::Periodic, Boundary::Free]);
    let mut lattice = IsingLattice::random(side, side, t, boundary, &mut cases.rng)?;
    for sweep in 0..100 {
        let before = lattice.energy();
        lattice.sweep(&mut cases.rng);
        let spins = lattice.spins();
        let sum: i64 = spins.iter().map(|&s| i64::from(s)).sum();
        let right = lattice.energy() == energy(spins, side, side, boundary)
            && lattice.magnetisation() == sum;
        let input = format_args!("side {side}, {boundary:?}, T = {t:e}, sweep {sweep}");
        if t < 0.1 {
            cases.keeps(1, input, lattice.energy() <= before)?;
        }
        cases.keeps(2, input, right)?;
    }
    Ok(())
}
