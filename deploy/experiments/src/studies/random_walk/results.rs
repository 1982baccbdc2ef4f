//! All trainings of the grid, and what follows from them together.

use serde::Serialize;

use super::{
    chain::Chain,
    training::{Learnt, Sampling, Settings},
};
use crate::{
    plot::{Band, Curve},
    stats::{Spread, rank_correlation},
};

#[derive(Serialize)]
pub(super) struct Trained {
    #[serde(flatten)]
    pub(super) chain: Chain,
    #[serde(skip)]
    pub(super) sampling: Sampling,
    pub(super) seed: u32,
    #[serde(skip)]
    pub(super) learnt: Learnt,
    /// Updates until the law of the next state is near the true one, however near a blind guess is; none if it never was.
    pub(super) updates_to_tv: Option<u64>,
    /// Updates until most of what there is to learn is learnt, however little that is; none if it never was.
    pub(super) updates_to_share: Option<u64>,
}

impl Trained {
    pub(super) fn final_tv(&self) -> f64 {
        self.learnt.tv.last().copied().unwrap_or(f64::NAN)
    }

    pub(super) fn final_excess(&self) -> f64 {
        self.learnt.excess.last().copied().unwrap_or(f64::NAN)
    }
}

/// When a training counts as converged.
pub(super) type Measure = fn(&Trained) -> Option<u64>;
pub(super) const TV: Measure = |it| it.updates_to_tv;
pub(super) const SHARE: Measure = |it| it.updates_to_share;

pub(super) struct Results {
    pub(super) settings: Settings,
    pub(super) trained: Vec<Trained>,
}

impl Results {
    /// Those of one sampling and bias, over seeds.
    pub(super) fn of(&self, sampling: Sampling, alpha: f64) -> impl Iterator<Item = &Trained> {
        let all = self.trained.iter();
        all.filter(move |one| one.sampling == sampling && one.chain.alpha == alpha)
    }

    pub(super) fn chain(&self, alpha: f64) -> Chain {
        Chain::new(self.settings.states, alpha)
    }

    /// T / rho at the figure's bias, [K, K].
    pub(super) fn true_ratio(&self) -> Vec<f64> {
        let chain = self.chain(self.settings.figure_alpha);
        let (t, rho) = (chain.transitions(), chain.stationary());
        let k = self.settings.states;
        (0..k * k).map(|at| t[at] / rho[at % k]).collect()
    }

    /// Its entries as they were learnt, over the seeds of stationary sampling.
    pub(super) fn learnt_ratio(&self) -> Vec<Spread> {
        let of = || self.of(Sampling::Stationary, self.settings.figure_alpha);
        let k = self.settings.states;
        let entry = |at: usize| Spread::of(of().map(|one| one.learnt.ratio[at]));
        (0..k * k).filter_map(entry).collect()
    }

    /// Mutual information as the scores of stationary sampling have it, in nats, of each seed.
    pub(super) fn learnt_information(&self, alpha: f64) -> Vec<f64> {
        let all = self.chain(alpha).mutual_information();
        let each = self.of(Sampling::Stationary, alpha);
        each.map(|one| all - one.final_excess()).collect()
    }

    /// The biases of the curves: the strongest below 0.5, one between, and the figure's.
    pub(super) fn shown(&self) -> Vec<f64> {
        let alphas = &self.settings.alphas;
        let is_figure = |alpha: &f64| *alpha == self.settings.figure_alpha;
        let figure = alphas.iter().position(is_figure).unwrap_or(0);
        let mut shown = vec![0, figure / 2, figure];
        shown.dedup();
        shown.into_iter().map(|at| alphas[at]).collect()
    }

    /// Total variation over updates, over the seeds of stationary sampling.
    pub(super) fn tv_curve(&self, alpha: f64) -> Curve {
        let each: Vec<_> = self.of(Sampling::Stationary, alpha).collect();
        let updates = each.iter().take(1).flat_map(|one| &one.learnt.updates);
        let means = updates.enumerate().map(|(at, &update)| {
            let values = each.iter().map(|one| one.learnt.tv[at]);
            (update as f64, values.collect())
        });
        Curve::of_means(means, Band::Range)
    }

    /// Of each seed, the rank correlation over alpha between 1 / gap and the updates until the error is small.
    ///
    /// A training that never got there counts as one update more than the longest.
    pub(super) fn gap_correlations(&self, sampling: Sampling, measure: Measure) -> Vec<f64> {
        let of_seed = |seed: u32| {
            let all = self.trained.iter();
            let of_seed = all.filter(|one| one.sampling == sampling && one.seed == seed);
            let pairs = of_seed.map(|one| {
                let time = measure(one).unwrap_or(self.settings.updates + 1);
                (1.0 / one.chain.spectral_gap(), time as f64)
            });
            rank_correlation(&pairs.collect::<Vec<_>>())
        };
        (1..=self.settings.seeds).filter_map(of_seed).collect()
    }
}
