//! The global DIM heads on one-hot states, trained with InfoNCE on pairs of successive states.
//! Heads, loss and optimiser are those of the learner. Torso, actions and returns are not used.

use candle_core::{Device, Tensor};
use driml_learner::{AdamSettings, Lambda, auxiliary::dim::Dim};
use driml_model::{Features, ModelConfig};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

use super::chain::Chain;
use crate::{progress::Progress, small, studies::dim::DimLearner};

/// The ratio of the update counts of two successive measurements.
const MEASURE_GROWTH: f64 = 1.04;
/// The number of transitions in the replay before the first update, for [`Sampling::OneWalker`].
const WARMUP_TRANSITIONS: usize = 16;

/// A table of `config.toml`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Settings {
    pub(super) states: usize,
    /// The probabilities of a step up, one for each chain.
    pub(super) alphas: Vec<f64>,
    /// The alpha of the drawn ratio matrices; it is among `alphas`.
    pub(super) figure_alpha: f64,
    /// The number of seeds, 1 to this. No piece depends on it, so that more seeds can be added later.
    #[serde(skip_serializing)]
    pub(super) seeds: u32,
    pub(super) updates: u64,
    /// The number of pairs in a batch. For each pair all others are negatives.
    pub(super) batch_size: usize,
    pub(super) embedding_dim: usize,
    /// Rows sampled per stored transition, for [`Sampling::OneWalker`].
    pub(super) replay_ratio: f64,
    /// The bound of the soft clip of scores.
    pub(super) tanh_clip: f64,
    /// The global 2-norm to which gradients are clipped.
    pub(super) max_grad_norm: f64,
    /// The total variation (a probability) of the next-state distribution at which a training counts as converged.
    #[serde(skip_serializing)]
    pub(super) tv_reached: f64,
    /// The share of the mutual information that may still be missing when a training counts as converged.
    #[serde(skip_serializing)]
    pub(super) share_reached: f64,
    pub(super) adam: AdamSettings,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Sampling {
    /// Independent pairs, with the first state from the stationary distribution, so that nothing has to mix.
    Stationary,
    /// Many walkers that all start in the lowest state. Update t learns from their t-th step, as in the paper's proposition.
    FromOneEnd,
    /// One walker adds a few transitions to a replay before each update, and batches are drawn from all of the replay, as in a run.
    OneWalker,
}

impl Sampling {
    pub(super) const ALL: [Self; 3] = [Self::Stationary, Self::FromOneEnd, Self::OneWalker];

    pub(super) const fn name(self) -> &'static str {
        match self {
            Self::Stationary => "stationary",
            Self::FromOneEnd => "from-one-end",
            Self::OneWalker => "one-walker",
        }
    }
}

/// The results of a training, measured without sampling noise from the scores of all K * K pairs.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub(super) struct Measurements {
    pub(super) updates: Vec<u64>,
    /// The InfoNCE loss with infinitely many negatives, above its minimum, in nats: E_rho KL(T_i || learnt T_i).
    pub(super) excess: Vec<f64>,
    /// The error of the next-state distribution, a probability: E_rho of the total variation between T_i and learnt T_i.
    pub(super) tv: Vec<f64>,
    /// The learnt ratio [K, K] at the end.
    pub(super) ratio: Vec<f64>,
}

pub(super) fn train(
    chain: &Chain,
    settings: &Settings,
    sampling: Sampling,
    seed: u64,
    progress: &mut Progress,
) -> anyhow::Result<Measurements> {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut learner = learner(chain.states, settings, &mut rng)?;
    let all = one_hot_features(chain.states, 0..chain.states)?;
    let mut source = pair_source(chain, settings, sampling, &mut rng);
    let (mut learnt, mut measure_next) = (Measurements::default(), 0);
    for update in 0..=settings.updates {
        if update >= measure_next || update == settings.updates {
            learnt.add_measurement(update, chain, learner.scores(&all, &all)?);
            measure_next = ((update as f64 * MEASURE_GROWTH).ceil() as u64).max(update + 1);
        }
        if update < settings.updates {
            let pairs = source(&mut rng);
            let now = one_hot_features(chain.states, pairs.iter().map(|pair| pair.0))?;
            let next = one_hot_features(chain.states, pairs.iter().map(|pair| pair.1))?;
            learner.update(&now, &next)?;
            progress.advance(1)?;
        }
    }
    Ok(learnt)
}

impl Measurements {
    /// Adds a measurement from the scores [K, K].
    ///
    /// At the optimum the score is ln(T_ij / rho_j) plus a constant for each i, which does not change the softmax. The constant comes from
    /// sum_j rho_j ratio_ij = 1, which T / rho fulfils.
    fn add_measurement(&mut self, update: u64, chain: &Chain, scores: Vec<f64>) {
        let k = chain.states;
        let (t, rho) = (chain.transition_matrix(), chain.stationary());
        let mut ratio = Vec::with_capacity(k * k);
        for row in scores.chunks(k) {
            let largest = row.iter().copied().fold(f64::NEG_INFINITY, f64::max);
            let weights = row.iter().map(|score| (score - largest).exp());
            let weights: Vec<f64> = weights.collect();
            let sum: f64 = weights.iter().zip(&rho).map(|(w, rho)| w * rho).sum();
            ratio.extend(weights.iter().map(|w| w / sum));
        }
        let (mut excess, mut tv) = (0.0, 0.0);
        for at in 0..k * k {
            let (i, j) = (at / k, at % k);
            let learnt = rho[j] * ratio[at];
            if t[at] > 0.0 {
                excess += rho[i] * t[at] * (t[at] / learnt).ln();
            }
            tv += 0.5 * rho[i] * (t[at] - learnt).abs();
        }
        self.updates.push(update);
        // Rounding can make a perfect fit slightly negative.
        self.excess.push(excess.max(0.0));
        self.tv.push(tv);
        self.ratio = ratio;
    }

    /// Returns the first measured update at which `measure` is at most `reached`; `None` if it never is.
    pub(super) fn updates_to(&self, measure: &[f64], reached: f64) -> Option<u64> {
        let at = measure.iter().position(|value| *value <= reached)?;
        Some(self.updates[at])
    }
}

/// Creates the heads Psi_4 and Phi_4 with their loss and optimiser.
///
/// The heads read f4, which is the one-hot state here. Torso and C51 head have the smallest possible size, and no loss reaches them.
fn learner(states: usize, settings: &Settings, rng: &mut ChaCha8Rng) -> anyhow::Result<DimLearner> {
    let lambda = Lambda {
        l4t4: 1.0,
        ..Lambda::NONE
    };
    let model = ModelConfig {
        embedding_dim: settings.embedding_dim,
        dim: lambda.dim_heads(false),
        ..small::config(2, states, (0.0, 1.0))
    };
    let tanh_clip = settings.tanh_clip;
    let dim = Dim { lambda, tanh_clip };
    DimLearner::new(&model, dim, settings.adam, settings.max_grad_norm, rng)
}

/// Returns the features of these states of a chain with `count` states, a row for each.
fn one_hot_features(
    count: usize,
    states: impl ExactSizeIterator<Item = usize>,
) -> candle_core::Result<Features> {
    let rows = states.len();
    let row = |state: usize| (0..count).map(move |it| f32::from(it == state));
    let values: Vec<f32> = states.flat_map(row).collect();
    Ok(Features {
        f3: None,
        f4: Tensor::from_vec(values, (rows, count), &Device::Cpu)?,
    })
}

type PairSource<'a> = Box<dyn FnMut(&mut ChaCha8Rng) -> Vec<(usize, usize)> + 'a>;

fn pair_source<'a>(
    chain: &'a Chain,
    settings: &Settings,
    sampling: Sampling,
    rng: &mut ChaCha8Rng,
) -> PairSource<'a> {
    let rows = settings.batch_size;
    match sampling {
        Sampling::Stationary => {
            let law = chain.stationary();
            let pair = move |rng: &mut ChaCha8Rng| walk(chain, &mut draw_state(&law, rng), rng);
            Box::new(move |rng| (0..rows).map(|_| pair(rng)).collect())
        }
        Sampling::FromOneEnd => {
            let mut walkers = vec![0; rows];
            Box::new(move |rng| {
                let each = walkers.iter_mut();
                each.map(|walker| walk(chain, walker, rng)).collect()
            })
        }
        Sampling::OneWalker => {
            let steps = ((rows as f64 / settings.replay_ratio).round() as usize).max(1);
            let (mut walker, mut replay) = (0, Vec::new());
            replay.extend((0..WARMUP_TRANSITIONS).map(|_| walk(chain, &mut walker, rng)));
            Box::new(move |rng| {
                replay.extend((0..steps).map(|_| walk(chain, &mut walker, rng)));
                let row = |_| replay[rng.random_range(0..replay.len())];
                (0..rows).map(row).collect()
            })
        }
    }
}

/// Steps from `state`, replaces it by the next state, and returns the pair of both.
fn walk(chain: &Chain, state: &mut usize, rng: &mut ChaCha8Rng) -> (usize, usize) {
    let before = *state;
    *state = chain.step(before, rng);
    (before, *state)
}

fn draw_state(law: &[f64], rng: &mut ChaCha8Rng) -> usize {
    let mut left: f64 = rng.random();
    for (index, p) in law.iter().enumerate() {
        left -= p;
        if left < 0.0 {
            return index;
        }
    }
    law.len() - 1
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        flags::{self, ExperimentFlags},
        studies::random_walk::SETTINGS,
    };
    use driml_protocol::GracefulShutdown;

    #[test]
    fn true_ratios_measure_as_no_error_and_constant_scores_as_the_mutual_information() {
        let chain = Chain::new(6, 0.3);
        let (t, rho) = (chain.transition_matrix(), chain.stationary());
        // Each row may have an arbitrary constant. A pair that never occurs has a score far below the others.
        let score = |at: usize| (t[at] / rho[at % 6]).max(1e-300).ln() + (at / 6) as f64;
        let mut learnt = Measurements::default();
        learnt.add_measurement(3, &chain, (0..36).map(score).collect());
        assert!(learnt.excess[0] < 1e-12 && learnt.tv[0] < 1e-12);
        for (at, ratio) in learnt.ratio.iter().enumerate() {
            assert!((ratio - t[at] / rho[at % 6]).abs() < 1e-9);
        }
        assert_eq!(learnt.updates_to(&learnt.tv, 0.1), Some(3));
        assert_eq!(learnt.updates_to(&learnt.tv, -1.0), None);
        learnt.add_measurement(4, &chain, vec![0.5; 36]);
        assert!((learnt.excess[1] - chain.mutual_information()).abs() < 1e-12);
    }

    #[test]
    fn every_sampling_learns_the_ratios_and_repeats_by_its_seed() {
        let settings = Settings {
            updates: 300,
            ..flags::read_settings(SETTINGS, &ExperimentFlags::default())
        };
        let chain = Chain::new(4, 0.4);
        for sampling in Sampling::ALL {
            let train = || {
                let mut progress = Progress::new(settings.updates, GracefulShutdown::default());
                train(&chain, &settings, sampling, 5, &mut progress).unwrap()
            };
            let learnt = train();
            let (first, last) = (learnt.tv[0], learnt.tv[learnt.tv.len() - 1]);
            let has_learnt = last < 0.1 && last < first / 3.0;
            assert!(has_learnt, "{sampling:?}: {first} to {last}");
            assert_eq!(train().ratio, learnt.ratio);
        }
    }
}
