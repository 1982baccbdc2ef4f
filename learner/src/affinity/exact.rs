//! Affinity in closed form, from exponentially decayed counts of action pairs.
//! It trains nothing. The learned estimate must converge to this one, both for frequent pairs and for pairs that were never seen.

use std::ops::RangeInclusive;

use serde::{Deserialize, Serialize};

use super::alphabet::Alphabet;
use crate::{
    error::Result,
    ranges::{NOT_NEGATIVE, PROBABILITY, check_array, check_ranges},
};

/// Decay and smoothing of the pair counts.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ExactSettings {
    /// Factor on all counts at each update, 1e-300 to 1.
    pub decay: f64,
    /// Number of pairs added to each pair's count and to its expected count for independent actions, from 1e-100 to 1e100. A larger
    /// value demands more evidence for a ratio other than 1.
    pub smoothing: f64,
}

/// Largest relative error of an entry of A, while the counts stay below 1e300: half a unit in the last place of an f32. Rows sum to 1
/// within 1e-6.
pub const ENTRY_ERROR: f64 = 6.1e-8;

/// Range of the smoothing, far inside the range of f64, so that ratios of counts are finite and above 0.
const SMOOTHING_RANGE: RangeInclusive<f64> = 1e-100..=1e100;

/// Decayed pair counts c and A = row softmax of `ln p(j | i) / p(j)`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ExactAffinity {
    pub(super) alphabet: Alphabet,
    pub(super) settings: ExactSettings,
    /// Decayed counts [m, m] by dense index.
    counts: Vec<f64>,
}

impl ExactSettings {
    pub(crate) fn check_valid(&self) -> Result<()> {
        check_ranges(&[
            ("decay", self.decay, 1e-300..=1.0),
            ("smoothing", self.smoothing, SMOOTHING_RANGE),
        ])
    }
}

impl ExactAffinity {
    /// Creates an estimate without counts: A is uniform over the alphabet.
    pub fn new(alphabet: Alphabet, settings: ExactSettings) -> Result<Self> {
        settings.check_valid()?;
        let m = alphabet.len();
        Ok(Self {
            counts: vec![0.0; m * m],
            alphabet,
            settings,
        })
    }

    pub(super) fn check_valid(&self) -> Result<()> {
        self.settings.check_valid()?;
        let m = self.alphabet.len();
        check_array("counts", &self.counts, m * m, NOT_NEGATIVE)?;
        check_array("matrix", &self.ratios(), m * m, PROBABILITY)
    }

    /// Learns from pairs of dense indices.
    pub(super) fn observe(&mut self, pairs: &[(u8, u8)]) {
        for count in &mut self.counts {
            *count *= self.settings.decay;
        }
        for &(i, j) in pairs {
            self.counts[usize::from(i) * self.alphabet.len() + usize::from(j)] += 1.0;
        }
    }

    /// Computes A [m, m] by dense index: A_ij = q_ij / sum_j q_ij, the row softmax of ln q, with q_ij = (c_ij + s) / (e_ij + s) and
    /// smoothing s. The count that independent actions would have is e_ij = sum_j c_ij * sum_i c_ij / sum c.
    ///
    /// q is p(j | i) / p(j) for frequent pairs, and 1 if nothing is known: in the row or column of an action that was never taken, and if
    /// only one action was ever taken. Adding s to c alone would bias the ratio there.
    /// Source of the form: DuMouchel 1999, the shrinking of a ratio of counts towards 1.
    pub(super) fn ratios(&self) -> Vec<f64> {
        let m = self.alphabet.len();
        let row = |i: usize| self.counts[i * m..(i + 1) * m].iter().sum::<f64>();
        let column = |j: usize| (0..m).map(|i| self.counts[i * m + j]).sum::<f64>();
        let rows: Vec<f64> = (0..m).map(row).collect();
        let columns: Vec<f64> = (0..m).map(column).collect();
        let total: f64 = rows.iter().sum();
        let smoothing = self.settings.smoothing;
        let ratio = |at: usize| {
            // The division comes first: the product of two counts could overflow.
            let share = if total > 0.0 {
                rows[at / m] / total
            } else {
                0.0
            };
            (self.counts[at] + smoothing) / (share * columns[at % m] + smoothing)
        };
        let mut ratios: Vec<f64> = (0..m * m).map(ratio).collect();
        for row in ratios.chunks_exact_mut(m) {
            let sum: f64 = row.iter().sum();
            row.iter_mut().for_each(|ratio| *ratio /= sum);
        }
        ratios
    }
}
