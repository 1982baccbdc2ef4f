//! Affinity as the paper learns it: a small network on action pairs, trained with the Jensen-Shannon bound.
//! It uses no tensors: with at most 255^2 distinct inputs, loops over the pairs are enough.

use rand::{Rng, seq::SliceRandom};
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

use super::alphabet::Alphabet;
use crate::{
    error::Result,
    ranges::{NOT_NEGATIVE, PROBABILITY, check_array, check_ranges},
};

/// Sizes, optimiser and smoothing of the learned estimate.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LearnedSettings {
    /// Hidden units, 1 to 4,096.
    pub hidden: usize,
    /// Adam's learning rate, from 1e-30 to 1e38: in this range, parameters and their products stay finite in f64 for the length of a run.
    pub lr: f64,
    /// Adam's decay of the first moment, 0 to 0.999999.
    pub beta1: f64,
    /// Adam's decay of the second moment, 0 to 0.999999.
    pub beta2: f64,
    /// Adam's epsilon, added outside the root, from 1e-30 to 1e30.
    pub eps: f64,
    /// Share of the old A that each update keeps, 0 to 0.999999: A <- keep * A + (1 - keep) * row softmax of q.
    pub keep: f64,
}

/// The network q(i, j) = out . relu(w_from[i] + w_to[j] + b) + c on one-hot pairs, its Adam state, and the smoothed A.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct LearnedAffinity {
    pub(super) alphabet: Alphabet,
    pub(super) settings: LearnedSettings,
    /// w_from [m, hidden], w_to [m, hidden], b [hidden], out [hidden], c [1], one after the other.
    parameters: Vec<f64>,
    first_moments: Vec<f64>,
    second_moments: Vec<f64>,
    updates: u64,
    /// Smoothed A [m, m] by dense index.
    pub(super) smoothed: Vec<f64>,
}

/// Largest number of hidden units; larger settings are rejected.
const HIDDEN_MAX: f64 = 4096.0;

impl LearnedSettings {
    pub(crate) fn check_valid(&self) -> Result<()> {
        let share = 0.0..=0.999_999;
        check_ranges(&[
            ("hidden", self.hidden as f64, 1.0..=HIDDEN_MAX),
            ("lr", self.lr, 1e-30..=1e38),
            ("eps", self.eps, 1e-30..=1e30),
            ("beta1", self.beta1, share.clone()),
            ("beta2", self.beta2, share.clone()),
            ("keep", self.keep, share),
        ])
    }
}

impl LearnedAffinity {
    /// Creates a network with weights drawn from `rng` and q = 0 everywhere, so that A is uniform over the alphabet.
    pub fn new(
        alphabet: Alphabet,
        settings: LearnedSettings,
        rng: &mut ChaCha8Rng,
    ) -> Result<Self> {
        settings.check_valid()?;
        let hidden = settings.hidden;
        let m = alphabet.len();
        let mut parameters = vec![0.0; parameter_count(m, hidden)];
        // The first layer is drawn as in PyTorch, U(+-1/sqrt(inputs)). The last layer stays 0, so that q starts at 0.
        let bound = 1.0 / ((2 * m) as f64).sqrt();
        for p in &mut parameters[..(2 * m + 1) * hidden] {
            *p = rng.random_range(-bound..bound);
        }
        let zeros = vec![0.0; parameters.len()];
        let smoothed = vec![1.0 / m as f64; m * m];
        Ok(Self {
            first_moments: zeros.clone(),
            second_moments: zeros,
            updates: 0,
            alphabet,
            settings,
            parameters,
            smoothed,
        })
    }

    pub(super) fn check_valid(&self) -> Result<()> {
        self.settings.check_valid()?;
        let m = self.alphabet.len();
        let count = parameter_count(m, self.settings.hidden);
        let finite = f64::MIN..=f64::MAX;
        check_array("parameters", &self.parameters, count, finite.clone())?;
        check_array("first_moments", &self.first_moments, count, finite)?;
        check_array("second_moments", &self.second_moments, count, NOT_NEGATIVE)?;
        check_array("smoothed", &self.smoothed, m * m, PROBABILITY)
    }

    /// Takes one Adam step up the bound `E_joint[-softplus(-q)] - E_marginal[softplus(q)]`, whose optimum is the log ratio
    /// `ln p(i, j) / (p(i) p(j))`. The joint pairs are the batch's, by dense index; the marginal pairs have their second actions shuffled
    /// by `rng`. Then A moves towards the new row softmax. Source: Mazoure et al. 2020, section 4; Hjelm et al. 2019, equation 4.
    pub(super) fn observe(&mut self, pairs: &[(u8, u8)], rng: &mut ChaCha8Rng) {
        let mut shuffled: Vec<u8> = pairs.iter().map(|&(_, j)| j).collect();
        shuffled.shuffle(rng);
        let m = self.alphabet.len();
        let q = self.q();
        let pair_weight = 1.0 / pairs.len() as f64;
        // Derivative of the loss (the bound, negated) by q.
        let mut by_q = vec![0.0; m * m];
        for (&(i, j), &other) in pairs.iter().zip(&shuffled) {
            let joint = usize::from(i) * m + usize::from(j);
            let marginal = usize::from(i) * m + usize::from(other);
            by_q[joint] -= pair_weight * sigmoid(-q[joint]);
            by_q[marginal] += pair_weight * sigmoid(q[marginal]);
        }
        let gradient = self.gradient(&by_q);
        self.step(&gradient);
        let keep = self.settings.keep;
        let new = row_softmax(&self.q(), m);
        for (old, new) in self.smoothed.iter_mut().zip(new) {
            *old = keep * *old + (1.0 - keep) * new;
        }
    }

    /// Offsets of w_to, b, out and c in `parameters`.
    const fn offsets(&self) -> [usize; 4] {
        let (m, hidden) = (self.alphabet.len(), self.settings.hidden);
        [
            m * hidden,
            2 * m * hidden,
            (2 * m + 1) * hidden,
            (2 * m + 2) * hidden,
        ]
    }

    /// Hidden unit `h` of the pair (i, j) before its ReLU.
    fn pre_activation(&self, i: usize, j: usize, h: usize) -> f64 {
        let ([to, b, ..], hidden) = (self.offsets(), self.settings.hidden);
        let p = &self.parameters;
        p[i * hidden + h] + p[to + j * hidden + h] + p[b + h]
    }

    /// The network's output q(i, j) for every pair of visible actions, [m, m].
    fn q(&self) -> Vec<f64> {
        let (m, [_, _, out, c]) = (self.alphabet.len(), self.offsets());
        let weights = &self.parameters[out..c];
        let q = |i: usize, j: usize| {
            let units = weights.iter().enumerate();
            let units = units.map(|(h, w)| w * self.pre_activation(i, j, h).max(0.0));
            units.sum::<f64>() + self.parameters[c]
        };
        (0..m * m).map(|at| q(at / m, at % m)).collect()
    }

    /// Derivative of the loss by the parameters, given its derivative by q.
    fn gradient(&self, by_q: &[f64]) -> Vec<f64> {
        let (m, hidden, [to, b, out, c]) =
            (self.alphabet.len(), self.settings.hidden, self.offsets());
        let mut gradient = vec![0.0; self.parameters.len()];
        for (at, &slope) in by_q.iter().enumerate().filter(|(_, slope)| **slope != 0.0) {
            let (i, j) = (at / m, at % m);
            gradient[c] += slope;
            for h in 0..hidden {
                let unit = self.pre_activation(i, j, h);
                if unit > 0.0 {
                    gradient[out + h] += slope * unit;
                    let by_unit = slope * self.parameters[out + h];
                    gradient[i * hidden + h] += by_unit;
                    gradient[to + j * hidden + h] += by_unit;
                    gradient[b + h] += by_unit;
                }
            }
        }
        gradient
    }

    fn step(&mut self, gradient: &[f64]) {
        let settings = self.settings;
        let (beta1, beta2) = (settings.beta1, settings.beta2);
        self.updates += 1;
        let t = i32::try_from(self.updates).unwrap_or(i32::MAX);
        let (correction1, correction2) = (1.0 - beta1.powi(t), 1.0 - beta2.powi(t));
        let moments = self.first_moments.iter_mut().zip(&mut self.second_moments);
        for ((p, &g), (m, v)) in self.parameters.iter_mut().zip(gradient).zip(moments) {
            *m = beta1 * *m + (1.0 - beta1) * g;
            *v = beta2 * *v + (1.0 - beta2) * g * g;
            let root = (*v / correction2).sqrt() + settings.eps;
            *p -= settings.lr * (*m / correction1) / root;
        }
    }
}

/// The number of parameters of the network over m visible actions.
const fn parameter_count(m: usize, hidden: usize) -> usize {
    (2 * m + 2) * hidden + 1
}

fn sigmoid(x: f64) -> f64 {
    1.0 / (1.0 + (-x).exp())
}

/// The softmax of each row of a matrix with `m` columns.
fn row_softmax(q: &[f64], m: usize) -> Vec<f64> {
    let mut matrix = Vec::with_capacity(q.len());
    for row in q.chunks_exact(m) {
        let max = row.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        let sum: f64 = row.iter().map(|q| (q - max).exp()).sum();
        matrix.extend(row.iter().map(|q| (q - max).exp() / sum));
    }
    matrix
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng;

    use super::*;
    use crate::affinity::tests::PRESET;

    const SETTINGS: LearnedSettings = LearnedSettings {
        hidden: 5,
        ..PRESET
    };

    fn learned_of_three_actions() -> (LearnedAffinity, ChaCha8Rng) {
        let (alphabet, mut rng) = (Alphabet::raw(3).unwrap(), ChaCha8Rng::seed_from_u64(3));
        let learned = LearnedAffinity::new(alphabet, SETTINGS, &mut rng);
        (learned.unwrap(), rng)
    }

    #[test]
    fn the_gradient_is_the_slope() {
        let (mut learned, mut rng) = learned_of_three_actions();
        for parameter in &mut learned.parameters {
            *parameter = rng.random_range(-1.0..1.0);
        }
        let by_q: Vec<f64> = (0..9).map(|i| f64::from(i) - 4.5).collect();
        let gradient = learned.gradient(&by_q);
        for (at, slope) in gradient.iter().enumerate() {
            let value = |by: f64| {
                let mut moved = learned.clone();
                moved.parameters[at] += by;
                moved.q().iter().zip(&by_q).map(|(q, g)| q * g).sum::<f64>()
            };
            let measured = (value(1e-6) - value(-1e-6)) / 2e-6;
            let error = (measured - slope).abs();
            assert!(error < 1e-6, "parameter {at}: {measured} and {slope}");
        }
    }

    /// After 2^24 updates, 0.999^t vanishes beside 1, so that bias corrections stay 1.
    #[test]
    fn updates_beyond_32_bits_are_counted() {
        let after = |updates| {
            let (mut learned, mut rng) = learned_of_three_actions();
            learned.updates = updates;
            for _ in 0..20 {
                let pairs = [(0, 1), (1, 2), (2, 0)];
                learned.observe(&pairs, &mut rng);
            }
            learned.smoothed
        };
        for updates in [1 << 31, 1 << 32, 1 << 40, 1 << 53] {
            assert_eq!(after(updates), after(1 << 24), "{updates}");
        }
    }

    #[test]
    fn it_starts_uniform() {
        let (alphabet, rng) = (Alphabet::new(&[1, 1, 2]), &mut ChaCha8Rng::seed_from_u64(3));
        let learned = LearnedAffinity::new(alphabet.unwrap(), SETTINGS, rng).unwrap();
        assert_eq!(learned.smoothed, [0.5; 4]);
    }
}
