//! Action affinity: how likely action j is after action i, compared with how likely j is overall, as a matrix A for the sampler.
//! It does not draw k (the replay server does) and does not send A.

pub mod alphabet;
pub mod exact;
pub mod learned;

use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

pub use alphabet::Alphabet;
pub use exact::{ExactAffinity, ExactSettings};
pub use learned::{LearnedAffinity, LearnedSettings};

use crate::error::Result;

/// An estimator of A from the pairs (a_t, a_{t+1}) of the learner's batches, with all of its state, which checkpoints save.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "estimator", rename_all = "kebab-case")]
pub enum AffinityEstimator {
    /// The paper's estimator: a small network trained with the Jensen-Shannon bound.
    Learned(LearnedAffinity),
    /// A closed form from decayed pair counts.
    Exact(ExactAffinity),
}

impl AffinityEstimator {
    /// Learns from one batch's pairs of raw actions, none of which crosses the end of an episode. Without pairs, nothing changes.
    ///
    /// # Errors
    /// An action that the alphabet does not have: nothing has then changed. Numbers that are no longer finite: the estimate is then
    /// unusable.
    pub fn observe(&mut self, pairs: &[(u8, u8)], rng: &mut ChaCha8Rng) -> Result<()> {
        let pairs = self.alphabet().index_pairs(pairs)?;
        if !pairs.is_empty() {
            match self {
                Self::Learned(learned) => learned.observe(&pairs, rng),
                Self::Exact(exact) => exact.observe(&pairs),
            }
        }
        self.check_valid()
    }

    /// Checks the invariants that [`AffinityEstimator::observe`] keeps. An estimate that was read from a file may violate them.
    pub fn check_valid(&self) -> Result<()> {
        self.alphabet().check_valid()?;
        match self {
            Self::Learned(learned) => learned.check_valid(),
            Self::Exact(exact) => exact.check_valid(),
        }
    }

    /// A by raw actions [n, n], `matrix[i * n + j] = A[visible(i), visible(j)]`, so that a reader does not need the alphabet.
    /// A row sums to 1 over one representative of each visible action.
    pub fn matrix(&self) -> Vec<f32> {
        match self {
            Self::Learned(learned) => learned.alphabet.expand_matrix(&learned.smoothed),
            Self::Exact(exact) => exact.alphabet.expand_matrix(&exact.ratios()),
        }
    }

    /// The alphabet and the settings of the estimator, without its state.
    pub(crate) fn settings(&self) -> (&Alphabet, Option<LearnedSettings>, Option<ExactSettings>) {
        match self {
            Self::Learned(learned) => (&learned.alphabet, Some(learned.settings), None),
            Self::Exact(exact) => (&exact.alphabet, None, Some(exact.settings)),
        }
    }

    fn alphabet(&self) -> &Alphabet {
        self.settings().0
    }

    /// The number of raw actions n, the side of the matrix.
    pub fn num_actions(&self) -> usize {
        self.alphabet().num_actions()
    }
}

#[cfg(test)]
mod tests {
    use rand::distr::{Distribution, weighted::WeightedIndex};
    use rand::{Rng, SeedableRng};

    use super::*;

    /// The settings of the preset `deploy/settings/presets/agent/driml-ada.toml`.
    pub(super) const PRESET: LearnedSettings = LearnedSettings {
        hidden: 32,
        lr: 2e-3,
        beta1: 0.9,
        beta2: 0.999,
        eps: 1e-8,
        keep: 0.9,
    };
    const EXACT: ExactSettings = ExactSettings {
        decay: 0.999,
        smoothing: 1.0,
    };
    const ACTIONS: usize = 15;
    const K_MAX: usize = 5;

    /// A source of actions as skewed as a game's. It repeats its action with probability 0.3, and otherwise draws action j with a
    /// probability proportional to 0.7^j, which differs by a factor of 150 between the first and the 15th action.
    struct SkewedSource {
        marginal: Vec<f64>,
    }

    impl SkewedSource {
        const REPEATS: f64 = 0.3;

        fn new() -> Self {
            let weights: Vec<f64> = (0..ACTIONS as i32).map(|j| 0.7f64.powi(j)).collect();
            let sum: f64 = weights.iter().sum();
            Self {
                marginal: weights.into_iter().map(|weight| weight / sum).collect(),
            }
        }

        fn transition(&self, from: usize, to: usize) -> f64 {
            let repeats = if from == to { Self::REPEATS } else { 0.0 };
            repeats + (1.0 - Self::REPEATS) * self.marginal[to]
        }

        /// A of the source itself: each row of p(j | i) / p(j), divided by its sum.
        fn matrix(&self) -> Vec<f32> {
            let mut matrix = Vec::new();
            for from in 0..ACTIONS {
                let ratio = |to: usize| self.transition(from, to) / self.marginal[to];
                let sum: f64 = (0..ACTIONS).map(ratio).sum();
                matrix.extend((0..ACTIONS).map(|to| (ratio(to) / sum) as f32));
            }
            matrix
        }

        /// Pairs as in a batch, each from another position in the replay.
        fn pairs(&self, count: usize, rng: &mut ChaCha8Rng) -> Vec<(u8, u8)> {
            let law = WeightedIndex::new(&self.marginal).unwrap();
            let mut pair = || {
                let from = law.sample(rng);
                let repeats = rng.random_bool(Self::REPEATS);
                let to = if repeats { from } else { law.sample(rng) };
                (from as u8, to as u8)
            };
            (0..count).map(|_| pair()).collect()
        }

        /// P(k > i) for i = 1, .., K_MAX - 1 if k follows `matrix`, over the source's sequences of actions.
        fn k_tail(&self, matrix: &[f32]) -> Vec<f64> {
            let mut alive = self.marginal.clone();
            let step = |alive: &[f64], to: usize| -> f64 {
                let from = alive.iter().enumerate();
                from.map(|(from, p)| {
                    p * self.transition(from, to) * f64::from(matrix[from * ACTIONS + to])
                })
                .sum()
            };
            let mut next = || {
                alive = (0..ACTIONS).map(|to| step(&alive, to)).collect();
                alive.iter().sum()
            };
            (1..K_MAX).map(|_| next()).collect()
        }
    }

    /// Total variation distance between two distributions of k, given their tails.
    fn distance(a: &[f64], b: &[f64]) -> f64 {
        let law = |tails: &[f64]| -> Vec<f64> {
            let from = [&[1.0], tails].concat();
            let to = [tails, &[0.0]].concat();
            from.iter().zip(to).map(|(from, to)| from - to).collect()
        };
        let each = law(a).into_iter().zip(law(b));
        each.map(|(a, b)| (a - b).abs()).sum::<f64>() / 2.0
    }

    /// The learned estimate starts uniform, with k hardly ever above 1, and converges slowly: the values of k within the first 1,500
    /// updates say nothing about the agent.
    #[test]
    fn with_the_preset_s_numbers_learned_and_exact_come_to_the_source_s_law_of_k() {
        let source = SkewedSource::new();
        let truth = source.k_tail(&source.matrix());
        for (batch, seed) in [(256, 4), (256, 5), (64, 4), (64, 5)] {
            let mut rng = ChaCha8Rng::seed_from_u64(seed);
            let alphabet = Alphabet::raw(ACTIONS).unwrap();
            let exact = ExactAffinity::new(alphabet.clone(), EXACT).unwrap();
            let learned = LearnedAffinity::new(alphabet, PRESET, &mut rng).unwrap();
            let mut exact = AffinityEstimator::Exact(exact);
            let mut learned = AffinityEstimator::Learned(learned);
            let mut after = |updates: u64| {
                for _ in 0..updates {
                    let pairs = source.pairs(batch, &mut rng);
                    exact.observe(&pairs, &mut rng).unwrap();
                    learned.observe(&pairs, &mut rng).unwrap();
                }
                [&learned, &exact].map(|it| source.k_tail(&it.matrix()))
            };
            let [learned, exact] = after(100);
            let after_100 = distance(&learned, &exact);
            let case = format!("seed {seed}, batches of {batch}");
            assert!(after_100 > 0.045, "{case}: {after_100} apart after 100");
            let [learned, exact] = after(1400);
            for (one, other, most) in [
                (&learned, &exact, 0.02),
                (&learned, &truth, 0.02),
                (&exact, &truth, 0.005),
            ] {
                let apart = distance(one, other);
                assert!(apart < most, "{case}: {apart} apart after 1500");
            }
        }
    }

    #[test]
    fn an_unknown_action_is_an_error_and_no_pairs_change_nothing() {
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let exact = ExactAffinity::new(Alphabet::raw(3).unwrap(), EXACT).unwrap();
        let mut exact = AffinityEstimator::Exact(exact);
        let before = exact.clone();
        assert!(exact.observe(&[(0, 1), (1, 3)], &mut rng).is_err());
        exact.observe(&[], &mut rng).unwrap();
        assert_eq!(exact, before);
        let matrix = exact.matrix();
        assert!(matrix.iter().all(|a| (a - 1.0 / 3.0).abs() < 1e-6));
    }
}
