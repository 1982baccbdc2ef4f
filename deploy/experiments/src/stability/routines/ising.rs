//! The Ising lattice: its law at the ends of the temperatures, and its books.

use driml_envs::{Boundary, IsingLattice};

use super::horizon::{DEVIATIONS, deviations};
use crate::stability::check::{Context, Routine, Row};

const ISING: Routine = Routine {
    name: "Ising lattice",
    range: "temperatures above 0 and up to 5; sides up to 4,096",
};

/// Energy of spins [height, width], each bond once.
fn energy(spins: &[i8], height: usize, width: usize, boundary: Boundary) -> i64 {
    let at = |r: usize, c: usize| i64::from(spins[r % height * width + c % width]);
    let periodic = boundary == Boundary::Periodic;
    let mut energy = 0;
    for r in 0..height {
        for c in 0..width {
            if r + 1 < height || periodic {
                energy -= at(r, c) * at(r + 1, c);
            }
            if c + 1 < width || periodic {
                energy -= at(r, c) * at(r, c + 1);
            }
        }
    }
    energy
}

/// P(E = -bonds + i) over all states of a lattice of so few sites that all can be counted.
fn law(height: usize, width: usize, temperature: f64, boundary: Boundary) -> (i64, Vec<f64>) {
    let sites = height * width;
    let spins = |state: usize| -> Vec<i8> {
        (0..sites)
            .map(|i| if state >> i & 1 == 1 { 1 } else { -1 })
            .collect()
    };
    let least = energy(&vec![1; sites], height, width, boundary);
    let mut law = vec![0.0; (-2 * least + 1) as usize];
    for state in 0..1usize << sites {
        let above = energy(&spins(state), height, width, boundary) - least;
        law[above as usize] += (-(above as f64) / temperature).exp();
    }
    let sum: f64 = law.iter().sum();
    (least, law.into_iter().map(|p| p / sum).collect())
}

pub(super) fn check(context: &mut Context<'_>) -> anyhow::Result<Vec<Row>> {
    let samples = (context.settings.law_draws / 8).max(2000);
    let mut boltzmann = Row::new(
        ISING,
        "3 x 3 periodic and 3 x 4 free, all states counted; T 2, 2.27, 4, 5",
        "deviations of a chi-square from the law of the energy",
        DEVIATIONS,
    );
    for (height, width, boundary) in [(3, 3, Boundary::Periodic), (3, 4, Boundary::Free)] {
        for temperature in [2.0, 2.269_185, 4.0, 5.0] {
            let rng = &mut context.rng;
            let mut lattice = IsingLattice::random(height, width, temperature, boundary, rng)?;
            let (least, law) = law(height, width, temperature, boundary);
            let mut counts = vec![0u64; law.len()];
            for sample in 0..samples + 20 {
                // So far apart that energies hardly know of each other.
                (0..30).for_each(|_| lattice.sweep(rng));
                if sample >= 20 {
                    counts[(lattice.energy() - least) as usize] += 1;
                }
            }
            boltzmann.see(deviations(&counts, &law).max(0.0), || {
                format!("{height} x {width}, {boundary:?}, T = {temperature}")
            });
            context.progress.advance(0)?;
        }
    }
    let mut cold = Row::new(
        ISING,
        "T 1e-300, 1e-9, 0.02; 3 x 3 to 64 x 64",
        "sweeps in which the energy rises",
        0.0,
    );
    let mut books = Row::new(
        ISING,
        "T 1e-300 to 5; 3 x 3 to 64 x 64",
        "sweeps after which energy or magnetisation is not that of the spins",
        0.0,
    );
    for side in [3usize, 7, 64] {
        for temperature in [1e-300, 1e-9, 0.02, 0.4, 2.27, 5.0] {
            for boundary in [Boundary::Periodic, Boundary::Free] {
                let rng = &mut context.rng;
                let mut lattice = IsingLattice::random(side, side, temperature, boundary, rng)?;
                for sweep in 0..100 {
                    let before = lattice.energy();
                    lattice.sweep(rng);
                    let input =
                        || format!("side {side}, {boundary:?}, T = {temperature:e}, sweep {sweep}");
                    if temperature < 0.1 {
                        cold.must(lattice.energy() <= before, input);
                    }
                    let spins = lattice.spins();
                    let sum: i64 = spins.iter().map(|&s| i64::from(s)).sum();
                    let right = lattice.energy() == energy(spins, side, side, boundary)
                        && lattice.magnetisation() == sum;
                    books.must(right, input);
                }
            }
        }
    }
    Ok(vec![boltzmann, cold, books])
}
