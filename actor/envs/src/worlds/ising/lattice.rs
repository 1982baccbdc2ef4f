//! A two-dimensional Ising model and its Metropolis dynamics.
//! It has no field, no couplings but J = 1 and no cluster moves, and it paints no frames.

use rand::Rng;
use serde::{Deserialize, Serialize};

use crate::error::{EnvError, require};
use crate::saved;

/// Neighbours of one site: up, down, left, right.
const NEIGHBOURS: usize = 4;

/// The neighbours beyond the rim of a lattice.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Boundary {
    /// Nothing: sites on the rim have fewer neighbours.
    Free,
    /// The opposite rim; needs at least 3 sites a side, so that no pair of sites is bound twice.
    Periodic,
}

/// Spins s in {-1, +1} with energy E = -sum over bonds of s_i s_j (J = 1, each bond once).
///
/// The stationary law of its sweeps is p(s) proportional to exp(-E / T). Sites may be absent (see `masked`); an
/// absent site has spin 0 and no bonds.
pub(crate) struct IsingLattice {
    /// Spins [H * W], then one absent site, which stands for all sites beyond the rim.
    spins: Vec<i8>,
    neighbours: Vec<[u32; NEIGHBOURS]>,
    /// The present sites: those with even row + column first, then the odd ones, each in row order.
    sites: Vec<u32>,
    /// A proposal with s * h = i - 4 > 0 is taken when a uniform u64 is below entry i: exp(-2 s h / T) * 2^64.
    accept_below: [u64; 2 * NEIGHBOURS + 1],
}

impl IsingLattice {
    /// A lattice of `height` x `width` sites at `temperature` (in units of J / k_B), each spin uniform on {-1, +1}. Worlds check their
    /// settings before: the temperature by [`check_temperature`], and the sides of a periodic lattice.
    pub(crate) fn random(
        height: usize,
        width: usize,
        temperature: f64,
        boundary: Boundary,
        rng: &mut impl Rng,
    ) -> Self {
        let all = vec![true; height * width];
        Self::masked(height, width, &all, temperature, boundary, rng)
    }

    /// As `random`, but only the sites with `present` [H * W] = true exist, at least one.
    pub(crate) fn masked(
        height: usize,
        width: usize,
        present: &[bool],
        temperature: f64,
        boundary: Boundary,
        rng: &mut impl Rng,
    ) -> Self {
        assert_eq!(present.len(), height * width, "present must be [H * W]");
        let sites_of = |colour: usize| {
            (0..height * width)
                .filter(move |i| present[*i] && (i / width + i % width) % 2 == colour)
                .map(|i| i as u32)
        };
        let mut lattice = Self {
            spins: vec![0; height * width + 1],
            neighbours: (0..height * width)
                .map(|i| neighbours_of(i, height, width, boundary))
                .collect(),
            sites: sites_of(0).chain(sites_of(1)).collect(),
            accept_below: accept_below(temperature),
        };
        lattice.randomise(rng);
        lattice
    }

    /// Draws every spin afresh, uniform on {-1, +1}.
    pub(crate) fn randomise(&mut self, rng: &mut impl Rng) {
        for chunk in self.sites.chunks(64) {
            let bits: u64 = rng.random();
            for (bit, &site) in chunk.iter().enumerate() {
                self.spins[site as usize] = if bits >> bit & 1 == 1 { 1 } else { -1 };
            }
        }
    }

    /// Sets the spins [H * W] to those of another lattice with the same sites.
    ///
    /// # Errors
    /// Spins that are not -1 or +1 exactly where there is a site, and 0 elsewhere.
    pub(crate) fn set_spins(&mut self, spins: &[i8]) -> Result<(), EnvError> {
        let current = &mut self.spins[..self.neighbours.len()];
        // 1 where there is a site, else 0.
        let mask = |spin: &i8| spin.unsigned_abs();
        let fits = spins.iter().map(mask).eq(current.iter().map(mask));
        saved::ensure_fits(fits, "a lattice")?;
        current.copy_from_slice(spins);
        Ok(())
    }

    /// One Metropolis proposal at each site, those with even row + column first; then one more at a site drawn uniformly.
    ///
    /// A proposal that does not raise the energy is always taken, so at low temperature a sweep is nearly a function of
    /// the spins: at T = 0.4 an inner site's smallest rise, 4, is taken with probability exp(-10). The last proposal is
    /// there because the others alone can be trapped: on a 3 x 3 periodic lattice 8 of the 512 states are never left or
    /// entered without it.
    pub(crate) fn sweep(&mut self, rng: &mut impl Rng) {
        for index in 0..self.sites.len() {
            self.propose(self.sites[index], rng);
        }
        let site = self.sites[rng.random_range(0..self.sites.len())];
        self.propose(site, rng);
    }

    /// Spins [H, W] in row order; 0 where there is no site.
    pub(crate) fn spins(&self) -> &[i8] {
        &self.spins[..self.neighbours.len()]
    }

    fn neighbour_sum(&self, site: usize) -> i32 {
        let neighbours = self.neighbours[site].iter();
        neighbours.map(|&n| i32::from(self.spins[n as usize])).sum()
    }

    /// Flips `site` with probability min(1, exp(-dE / T)), dE = 2 s h, h the sum of its neighbours.
    #[inline]
    fn propose(&mut self, site: u32, rng: &mut impl Rng) {
        let site = site as usize;
        let spin = i32::from(self.spins[site]);
        let aligned = spin * self.neighbour_sum(site);
        if aligned <= 0
            || rng.random::<u64>() < self.accept_below[(aligned + NEIGHBOURS as i32) as usize]
        {
            self.spins[site] = -spin as i8;
        }
    }

    /// Total energy E, in units of J.
    #[cfg(test)]
    pub(super) fn energy(&self) -> i64 {
        let bonds = |site: usize| i64::from(self.spins[site]) * i64::from(self.neighbour_sum(site));
        let twice: i64 = self.sites.iter().map(|&site| bonds(site as usize)).sum();
        -twice / 2
    }
}

/// The highest temperature, in units of J / k_B; a higher one is rejected. Above it nearly every proposal is taken. As sweeps propose in a
/// fixed order, they then turn the whole lattice over and back: the mean of s s' over a sweep is -0.4 at T = 5, -0.97 at T = 100.
const TEMPERATURE_MAX: f64 = 5.0;

/// Rejects a temperature that is not above 0 and at most 5.
pub(crate) fn check_temperature(temperature: f64) -> Result<(), EnvError> {
    let why = format!(
        "an Ising temperature must be above 0 and at most {TEMPERATURE_MAX}, beyond which sweeps turn the whole lattice over; got \
         {temperature}"
    );
    require(temperature > 0.0 && temperature <= TEMPERATURE_MAX, why)
}

fn accept_below(temperature: f64) -> [u64; 2 * NEIGHBOURS + 1] {
    std::array::from_fn(|i| {
        let aligned = i as f64 - NEIGHBOURS as f64;
        // The cast saturates, so a probability that rounds to 1 is still taken all but once in 2^64.
        ((-2.0 * aligned / temperature).exp().min(1.0) * 2f64.powi(64)) as u64
    })
}

/// Returns the sites up, down, left and right of `site`; `height * width` stands for one that does not exist.
pub(crate) fn neighbours_of(
    site: usize,
    height: usize,
    width: usize,
    boundary: Boundary,
) -> [u32; NEIGHBOURS] {
    let (row, column) = ((site / width) as isize, (site % width) as isize);
    [(-1, 0), (1, 0), (0, -1), (0, 1)].map(|(down, right)| {
        let (r, c) = (row + down, column + right);
        let inside = (0..height as isize).contains(&r) && (0..width as isize).contains(&c);
        let wrapped =
            r.rem_euclid(height as isize) as usize * width + c.rem_euclid(width as isize) as usize;
        if inside || boundary == Boundary::Periodic {
            wrapped as u32
        } else {
            (height * width) as u32
        }
    })
}
