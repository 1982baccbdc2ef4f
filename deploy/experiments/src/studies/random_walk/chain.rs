//! The biased random walk on 0..K, in closed form and by numerical linear algebra.
//! This module learns nothing.
//!
//! The walk steps from i to i + 1 with probability alpha, else to i - 1. At an end, a step that would leave the line stays in place.

use rand::Rng;
use serde::Serialize;

/// A biased random walk on a line of states. Its transition ratio is known in closed form.
#[derive(Clone, Debug, Serialize)]
pub(super) struct Chain {
    /// The number of states K, at least 2.
    pub(super) states: usize,
    /// The probability of a step up, in [0, 1].
    pub(super) alpha: f64,
}

impl Chain {
    pub(super) const fn new(states: usize, alpha: f64) -> Self {
        Self { states, alpha }
    }

    /// Returns T [K, K], row-major: T[i, j] is the probability of a step from i to j.
    pub(super) fn transition_matrix(&self) -> Vec<f64> {
        let k = self.states;
        let mut matrix = vec![0.0; k * k];
        for i in 0..k {
            matrix[i * k + (i + 1).min(k - 1)] += self.alpha;
            matrix[i * k + i.saturating_sub(1)] += 1.0 - self.alpha;
        }
        matrix
    }

    /// Returns ln of the stationary distribution at each state.
    ///
    /// rho(i) = r^i (1 - r) / (1 - r^K), r = alpha / (1 - alpha); 1 / K at r = 1. Powers are taken from the likelier end, so that none
    /// exceeds 1. Source: the paper's appendix. The formula is exact for this chain, which satisfies detailed balance.
    fn log_stationary(&self) -> Vec<f64> {
        // The rate is infinite for a walk that only moves in one direction.
        let rate = (self.alpha / (1.0 - self.alpha)).ln().abs();
        let log_weight = |d: usize| match d {
            0 => 0.0,
            d => -(d as f64) * rate,
        };
        let sum: f64 = (0..self.states).map(|d| log_weight(d).exp()).sum();
        let law = (0..self.states).map(|d| log_weight(d) - sum.ln());
        match self.alpha > 0.5 {
            true => law.rev().collect(),
            false => law.collect(),
        }
    }

    /// Returns the stationary distribution rho: see [`Chain::log_stationary`].
    pub(super) fn stationary(&self) -> Vec<f64> {
        self.log_stationary().into_iter().map(f64::exp).collect()
    }

    /// Returns I(S_t; S_{t+1}) at stationarity, in nats: H(rho) - h(alpha), because every row of T is (alpha, 1 - alpha).
    pub(super) fn mutual_information(&self) -> f64 {
        entropy(&self.stationary()) - entropy(&[self.alpha, 1.0 - self.alpha])
    }

    /// Returns the mutual information on a ring, which has no ends: ln K - h(alpha), in nats.
    pub(super) fn mutual_information_of_a_ring(&self) -> f64 {
        (self.states as f64).ln() - entropy(&[self.alpha, 1.0 - self.alpha])
    }

    /// Returns the double sum of the paper's appendix for the mutual information, as printed, in nats.
    ///
    /// The factor alpha^[j > i] (1 - alpha)^[j < i] is a step probability only for neighbours j of i, but the printed sum has all i and j.
    pub(super) fn mutual_information_as_printed(&self) -> f64 {
        let log_rho = self.log_stationary();
        let factor = |i: usize, j: usize| match j.cmp(&i) {
            std::cmp::Ordering::Greater => self.alpha,
            std::cmp::Ordering::Less => 1.0 - self.alpha,
            std::cmp::Ordering::Equal => 1.0,
        };
        let all = (0..self.states).flat_map(|i| (0..self.states).map(move |j| (i, j)));
        let term = |(i, j): (usize, usize)| match log_rho[i].exp() * factor(i, j) {
            0.0 => 0.0,
            p => p * (factor(i, j).ln() - log_rho[j]),
        };
        all.map(term).sum()
    }

    /// Returns the spectral gap 1 - lambda_2 = 1 - 2 sqrt(alpha (1 - alpha)) cos(pi / K).
    ///
    /// Computed without cancellation as (sqrt(1 - alpha) - sqrt(alpha))^2 + 4 sqrt(alpha (1 - alpha)) sin^2(pi / 2K).
    /// The smallest eigenvalue is -lambda_2, so this is also the absolute gap.
    /// Source: Feller, An Introduction to Probability Theory, vol. 1, XVI.3.
    pub(super) fn spectral_gap(&self) -> f64 {
        let (up, down) = (self.alpha.sqrt(), (1.0 - self.alpha).sqrt());
        let difference = (1.0 - 2.0 * self.alpha) / (up + down);
        let sine = (std::f64::consts::PI / (2 * self.states) as f64).sin();
        difference * difference + 4.0 * up * down * sine * sine
    }

    /// Returns the stationary distribution as the first row of T^(2^40), scaled to trace 1. All rows are equal.
    fn stationary_numerically(&self) -> Vec<f64> {
        let mut rows = high_power(self.transition_matrix(), self.states);
        rows.truncate(self.states);
        rows
    }

    /// Returns the mutual information as the sum of rho_i T_ij ln(T_ij / rho_j), in nats.
    pub(super) fn mutual_information_numerically(&self) -> f64 {
        let (t, k) = (self.transition_matrix(), self.states);
        let rho = self.stationary_numerically();
        let term = |at: usize| match t[at] {
            0.0 => 0.0,
            p => rho[at / k] * p * (p / rho[at % k]).ln(),
        };
        (0..k * k).map(term).sum()
    }

    /// Returns 1 - lambda_2 from the symmetric matrix sqrt(T_ij T_ji). By detailed balance it has the eigenvalues of T.
    ///
    /// The first eigenvalue, 1 with eigenvector sqrt(rho), is removed. Then lambda_2 is the largest, and a high power of 1 + matrix is
    /// v v^T of its eigenvector v.
    pub(super) fn spectral_gap_numerically(&self) -> f64 {
        let (t, k) = (self.transition_matrix(), self.states);
        let rho = self.stationary_numerically();
        let entry = |at: usize| {
            let (i, j) = (at / k, at % k);
            (t[at] * t[j * k + i]).sqrt() - (rho[i] * rho[j]).sqrt()
        };
        let matrix: Vec<f64> = (0..k * k).map(entry).collect();
        let mut shifted = matrix.clone();
        shifted.iter_mut().step_by(k + 1).for_each(|it| *it += 1.0);
        let projection = high_power(shifted, k);
        // lambda_2 = v^T matrix v.
        let terms = matrix.iter().zip(projection).map(|(a, b)| a * b);
        1.0 - terms.sum::<f64>()
    }

    pub(super) fn step(&self, state: usize, rng: &mut impl Rng) -> usize {
        if rng.random::<f64>() < self.alpha {
            (state + 1).min(self.states - 1)
        } else {
            state.saturating_sub(1)
        }
    }
}

fn entropy(law: &[f64]) -> f64 {
    let terms = law.iter().filter(|p| **p > 0.0).map(|p| p * p.ln());
    -terms.sum::<f64>()
}

/// Returns the power 2^40 of a matrix [k, k] by repeated squaring, divided by its trace.
fn high_power(mut matrix: Vec<f64>, k: usize) -> Vec<f64> {
    for _ in 0..40 {
        let term = |at: usize, l: usize| matrix[at / k * k + l] * matrix[l * k + at % k];
        let entry = |at| (0..k).map(|l| term(at, l)).sum();
        let square: Vec<f64> = (0..k * k).map(entry).collect();
        // The scale is normalised each time, because squaring would double the drift from rounding.
        let trace: f64 = square.iter().step_by(k + 1).sum();
        matrix = square.into_iter().map(|it| it / trace).collect();
    }
    matrix
}

#[cfg(test)]
mod tests {
    use super::*;

    fn assert_near(a: f64, b: f64, what: &str) {
        let error = (a - b).abs() / b.abs().max(1.0);
        assert!(error < 1e-9, "{what}: {a} and {b}");
    }

    #[test]
    fn closed_forms_are_what_linear_algebra_finds() {
        for states in [2, 3, 10, 17] {
            for alpha in [0.05, 0.3, 0.499, 0.5, 0.7, 0.95] {
                let chain = Chain { states, alpha };
                let what = format!("K = {states}, alpha = {alpha}");
                let laws = [chain.stationary(), chain.stationary_numerically()];
                let pairs = laws[0].iter().zip(&laws[1]);
                pairs.for_each(|(a, b)| assert_near(*a, *b, &what));
                let information = chain.mutual_information_numerically();
                assert_near(chain.mutual_information(), information, &what);
                let gap = chain.spectral_gap_numerically();
                assert_near(chain.spectral_gap(), gap, &what);
            }
        }
    }

    #[test]
    fn walks_that_only_go_one_way_stand_at_the_end() {
        for (alpha, end) in [(0.0, 0), (1.0, 9)] {
            let chain = Chain { states: 10, alpha };
            let rho = chain.stationary();
            let expected: Vec<f64> = (0..10).map(|i| f64::from(u8::from(i == end))).collect();
            assert_eq!(rho, expected);
            assert_eq!(chain.mutual_information(), 0.0);
            assert_eq!(chain.mutual_information_as_printed(), 0.0);
            assert_eq!(chain.spectral_gap(), 1.0);
        }
    }

    /// The paper reads the opposite from its Fig. 1c, for the chain that it describes.
    #[test]
    fn even_odds_are_where_the_walk_tells_most_about_its_next_state() {
        let at = |alpha| Chain { states: 10, alpha };
        let even = at(0.5).mutual_information();
        for alpha in [0.05, 0.3, 0.45, 0.55, 0.9] {
            let chain = at(alpha);
            assert!(chain.mutual_information() < even);
            assert!(chain.mutual_information_of_a_ring() > at(0.5).mutual_information_of_a_ring());
            // This is more information than ten states can hold.
            assert!(chain.mutual_information_as_printed() > 10f64.ln());
        }
    }
}
