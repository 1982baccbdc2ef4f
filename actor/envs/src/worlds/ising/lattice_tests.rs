//! The Ising lattice against exact enumeration.

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use super::lattice::*;

/// Exact law over all 2^(H * W) states: (probability of each, mean E, mean |m|). Bit i is the spin of site i.
fn enumerate(
    height: usize,
    width: usize,
    temperature: f64,
    boundary: Boundary,
) -> (Vec<f64>, f64, f64) {
    let sites = height * width;
    let energy_and_m = |state: usize| {
        let s = |i: usize| if state >> i & 1 == 1 { 1i64 } else { -1 };
        let mut energy = 0;
        for row in 0..height {
            for column in 0..width {
                let here = s(row * width + column);
                if row + 1 < height || boundary == Boundary::Periodic {
                    energy -= here * s((row + 1) % height * width + column);
                }
                if column + 1 < width || boundary == Boundary::Periodic {
                    energy -= here * s(row * width + (column + 1) % width);
                }
            }
        }
        (energy as f64, (0..sites).map(s).sum::<i64>().abs() as f64)
    };
    let weights: Vec<f64> = (0..1 << sites)
        .map(|x| (-energy_and_m(x).0 / temperature).exp())
        .collect();
    let z: f64 = weights.iter().sum();
    let p: Vec<f64> = weights.iter().map(|w| w / z).collect();
    let mean = |f: &dyn Fn(usize) -> f64| p.iter().enumerate().map(|(x, p)| p * f(x)).sum();
    let (e, m) = (mean(&|x| energy_and_m(x).0), mean(&|x| energy_and_m(x).1));
    (p, e, m)
}

/// Mean of `samples` within 5 standard errors of `exact`, the error from 100 batch means.
fn assert_mean(samples: &[f64], exact: f64, what: &str) {
    let batches: Vec<f64> = samples
        .chunks(samples.len() / 100)
        .map(|b| b.iter().sum::<f64>() / b.len() as f64)
        .collect();
    let mean = batches.iter().sum::<f64>() / batches.len() as f64;
    let variance =
        batches.iter().map(|b| (b - mean).powi(2)).sum::<f64>() / (batches.len() - 1) as f64;
    let error = (variance / batches.len() as f64).sqrt();
    assert!(
        (mean - exact).abs() < 5.0 * error,
        "{what}: sampled {mean} +- {error}, exact {exact}"
    );
}

fn assert_samples_law(height: usize, width: usize, temperature: f64, boundary: Boundary) {
    let mut rng = ChaCha8Rng::seed_from_u64(1);
    let mut lattice = IsingLattice::random(height, width, temperature, boundary, &mut rng);
    let (p, mean_energy, mean_m) = enumerate(height, width, temperature, boundary);
    let samples = 60_000;
    let (mut counts, mut energies, mut ms) = (vec![0u32; p.len()], vec![], vec![]);
    for sample in 0..samples + 100 {
        // 10 sweeps apart the states are near enough to independent for the chi-square below.
        for _ in 0..10 {
            lattice.sweep(&mut rng);
        }
        if sample >= 100 {
            let spins = lattice.spins().iter().rev();
            let state = spins.fold(0, |x, &s| x << 1 | usize::from(s == 1));
            counts[state] += 1;
            energies.push(lattice.energy() as f64);
            let m: i32 = lattice.spins().iter().map(|&s| i32::from(s)).sum();
            ms.push(f64::from(m.abs()));
        }
    }
    assert_mean(&energies, mean_energy, "mean energy");
    assert_mean(&ms, mean_m, "mean |m|");
    // States with fewer than 5 expected visits share one bin.
    let (mut chi, mut bins, mut rest) = (0.0, 0, (0.0, 0.0));
    for (count, p) in counts.iter().zip(&p) {
        let (seen, expected) = (f64::from(*count), p * f64::from(samples));
        if expected >= 5.0 {
            chi += (seen - expected).powi(2) / expected;
            bins += 1;
        } else {
            rest = (rest.0 + seen, rest.1 + expected);
        }
    }
    if rest.1 >= 5.0 {
        chi += (rest.0 - rest.1).powi(2) / rest.1;
        bins += 1;
    }
    let dof = f64::from(bins - 1);
    assert!(
        chi < dof + 5.0 * (2.0 * dof).sqrt(),
        "chi-square {chi} on {dof} degrees of freedom"
    );
}

#[test]
fn sweeps_sample_the_boltzmann_law() {
    for (width, boundary, temperatures) in [
        (3, Boundary::Periodic, [2.0, 4.0, 5.0]),
        (4, Boundary::Free, [2.0, 2.5, 5.0]),
    ] {
        for temperature in temperatures {
            assert_samples_law(3, width, temperature, boundary);
        }
    }
}

#[test]
fn near_temperature_0_no_sweep_raises_the_energy() {
    let mut rng = ChaCha8Rng::seed_from_u64(6);
    for (temperature, side) in [(1e-300, 3), (1e-9, 7), (0.02, 64)] {
        for boundary in [Boundary::Free, Boundary::Periodic] {
            let mut lattice = IsingLattice::random(side, side, temperature, boundary, &mut rng);
            for _ in 0..100 {
                let before = lattice.energy();
                lattice.sweep(&mut rng);
                assert!(lattice.energy() <= before, "T = {temperature:e}");
            }
        }
    }
}

#[test]
fn absent_sites_stay_absent_and_have_no_bonds() {
    let mut rng = ChaCha8Rng::seed_from_u64(4);
    // Two columns apart: 2 bonds in each, none between them.
    let present = [true, false, true].repeat(3);
    let mut lattice = IsingLattice::masked(3, 3, &present, 0.1, Boundary::Free, &mut rng);
    for _ in 0..1_000 {
        lattice.sweep(&mut rng);
        let mut spins = lattice.spins().iter().zip(&present);
        assert!(spins.all(|(s, p)| s.abs() == i8::from(*p)));
    }
    let aligned: Vec<i8> = present.iter().map(|&it| i8::from(it)).collect();
    lattice.set_spins(&aligned).unwrap();
    assert_eq!(lattice.energy(), -4);
    for absent in [1, -1, i8::MIN] {
        let mut spins = aligned.clone();
        spins[1] = absent;
        assert!(lattice.set_spins(&spins).is_err(), "{absent}");
    }
}

/// Mean of s(now) s(earlier) over the sites of a large lattice, for states one and two sweeps apart.
fn mean_overlaps(temperature: f64) -> [f64; 2] {
    let rng = &mut ChaCha8Rng::seed_from_u64(9);
    let periodic = Boundary::Periodic;
    let mut lattice = IsingLattice::random(64, 64, temperature, periodic, rng);
    let mut states: Vec<Vec<i8>> = Vec::new();
    for _ in 0..120 {
        lattice.sweep(rng);
        states.push(lattice.spins().to_vec());
    }
    let overlap = |a: &[i8], b: &[i8]| -> f64 {
        let products = a.iter().zip(b).map(|(a, b)| f64::from(a * b));
        products.sum::<f64>() / a.len() as f64
    };
    let settled = &states[20..];
    [1, 2].map(|apart| {
        let pairs = settled.windows(apart + 1);
        pairs.map(|w| overlap(&w[0], &w[apart])).sum::<f64>() / (settled.len() - apart) as f64
    })
}

/// Metropolis takes nearly every proposal of a hot lattice, and in a fixed order that turns all spins over, sweep after sweep.
#[test]
fn a_lattice_at_the_hottest_temperature_does_not_blink() {
    for temperature in [2.5, 4.0, 5.0] {
        let [one, two] = mean_overlaps(temperature);
        assert!(one > -0.5 && two < 0.5, "T = {temperature}: {one}, {two}");
    }
}
