//! Affinity in closed form, from exponentially decayed counts of action pairs.
//! It trains nothing; it is what the learned estimate must converge to.

use serde::{Deserialize, Serialize};

use super::{
    alphabet::Alphabet,
    arrays::{check_array, check_probabilities, row_softmax},
    bits,
    error::AffinityError,
};

/// The counts' numbers.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ExactSettings {
    /// Factor on all counts at each update, in (0, 1].
    pub decay: f64,
    /// Pairs added to the count of each pair, above 0.
    pub smoothing: f64,
}

/// Decayed pair counts c and A = row softmax of `ln p(j | i) / p(j)`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ExactAffinity {
    alphabet: Alphabet,
    settings: ExactSettings,
    /// [m, m] by dense visible indices.
    #[serde(with = "bits")]
    counts: Vec<f64>,
    /// [n, n] by raw actions.
    #[serde(with = "bits")]
    matrix: Vec<f32>,
}

impl ExactSettings {
    fn check_valid(&self) -> Result<(), AffinityError> {
        let Self { decay, smoothing } = *self;
        if decay > 0.0 && decay <= 1.0 && smoothing > 0.0 && smoothing.is_finite() {
            return Ok(());
        }
        Err(AffinityError(format!(
            "a decay of {decay} and a smoothing of {smoothing}"
        )))
    }
}

impl ExactAffinity {
    /// No counts yet: A is uniform over the alphabet.
    ///
    /// # Errors
    /// A setting out of its range.
    pub fn new(alphabet: Alphabet, settings: ExactSettings) -> Result<Self, AffinityError> {
        settings.check_valid()?;
        let m = alphabet.len();
        let mut exact = Self {
            counts: vec![0.0; m * m],
            matrix: Vec::new(),
            alphabet,
            settings,
        };
        exact.matrix = exact.alphabet.expand(&exact.softmax());
        Ok(exact)
    }

    /// Whether both estimate in the same way over the same actions.
    pub(super) fn has_settings_of(&self, other: &Self) -> bool {
        self.alphabet == other.alphabet && self.settings == other.settings
    }

    pub(super) fn check_valid(&self) -> Result<(), AffinityError> {
        self.alphabet.check_valid()?;
        self.settings.check_valid()?;
        let (m, n) = (self.alphabet.len(), self.alphabet.num_actions());
        check_array("counts", &self.counts, m * m)?;
        if let Some(at) = self.counts.iter().position(|&count| count < 0.0) {
            return Err(AffinityError(format!("counts is below 0 at index {at}")));
        }
        check_probabilities("matrix", &self.matrix, n * n)
    }

    pub(super) const fn alphabet(&self) -> &Alphabet {
        &self.alphabet
    }

    pub(super) fn matrix(&self) -> &[f32] {
        &self.matrix
    }

    pub(super) fn observe(&mut self, pairs: &[(u8, u8)]) -> Result<(), AffinityError> {
        let pairs = self.alphabet.map_pairs(pairs)?;
        if pairs.is_empty() {
            return Ok(());
        }
        self.counts
            .iter_mut()
            .for_each(|count| *count *= self.settings.decay);
        for (i, j) in pairs {
            self.counts[usize::from(i) * self.alphabet.len() + usize::from(j)] += 1.0;
        }
        self.matrix = self.alphabet.expand(&self.softmax());
        Ok(())
    }

    /// With `w = c + smoothing`: `q[i, j] = ln (w_ij / sum_j w_ij) - ln (sum_i w_ij / sum w)`, then row softmax.
    fn softmax(&self) -> Vec<f64> {
        let m = self.alphabet.len();
        let weight = |i: usize, j: usize| self.counts[i * m + j] + self.settings.smoothing;
        let row = |i: usize| (0..m).map(|j| weight(i, j)).sum::<f64>();
        let column = |j: usize| (0..m).map(|i| weight(i, j)).sum::<f64>();
        let rows: Vec<f64> = (0..m).map(row).collect();
        let columns: Vec<f64> = (0..m).map(column).collect();
        let total: f64 = rows.iter().sum();
        let q = |i: usize, j: usize| (weight(i, j) / rows[i]).ln() - (columns[j] / total).ln();
        let q: Vec<f64> = (0..m * m).map(|at| q(at / m, at % m)).collect();
        row_softmax(&q, m)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn it_is_the_closed_form_of_its_counts() {
        let settings = ExactSettings {
            decay: 0.5,
            smoothing: 1.0,
        };
        let mut exact = ExactAffinity::new(Alphabet::raw(2).unwrap(), settings).unwrap();
        exact.observe(&[(0, 0), (0, 0), (0, 1), (1, 1)]).unwrap();
        exact.observe(&[(1, 0)]).unwrap();
        // Counts 1, 0.5, 1, 0.5 and one more each: rows 3.5 and 3.5, columns 4 and 3.
        let q = |w: f64, column: f64| (w / 3.5) / (column / 7.0);
        let (a, b) = (q(2.0, 4.0), q(1.5, 3.0));
        for row in exact.matrix().chunks_exact(2) {
            assert!((f64::from(row[0]) - a / (a + b)).abs() < 1e-7);
            assert!((row[0] + row[1] - 1.0).abs() < 1e-6);
        }
    }

    #[test]
    fn settings_are_checked() {
        for (decay, smoothing) in [(0.0, 1.0), (1.1, 1.0), (0.9, 0.0), (f64::NAN, 1.0)] {
            let settings = ExactSettings { decay, smoothing };
            assert!(ExactAffinity::new(Alphabet::raw(2).unwrap(), settings).is_err());
        }
    }
}
