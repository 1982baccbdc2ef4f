//! All trainings of the grid, and the results over several of them.

use driml_launch::metrics::rounded;
use serde::Serialize;

use super::{
    chain::Chain,
    training::{Measurements, Sampling, Settings},
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
    pub(super) learnt: Measurements,
    /// The updates until the next-state distribution is within `tv_reached`, even if an untrained one is; `None` if it never is.
    pub(super) updates_to_tv: Option<u64>,
    /// The updates until only `share_reached` of the mutual information is missing, however small that is; `None` if that never happens.
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

/// Returns the updates until a training counts as converged, by one criterion.
pub(super) type UpdatesTo = fn(&Trained) -> Option<u64>;
pub(super) const TO_TV: UpdatesTo = |it| it.updates_to_tv;
pub(super) const TO_SHARE: UpdatesTo = |it| it.updates_to_share;

pub(super) struct Results {
    pub(super) settings: Settings,
    pub(super) trained: Vec<Trained>,
}

impl Results {
    pub(super) fn select(&self, sampling: Sampling, alpha: f64) -> impl Iterator<Item = &Trained> {
        let all = self.trained.iter();
        all.filter(move |one| one.sampling == sampling && one.chain.alpha == alpha)
    }

    pub(super) fn chain(&self, alpha: f64) -> Chain {
        Chain::new(self.settings.states, alpha)
    }

    /// Returns T / rho at the figure's bias, [K, K].
    pub(super) fn true_ratio(&self) -> Vec<f64> {
        let chain = self.chain(self.settings.figure_alpha);
        let (t, rho) = (chain.transition_matrix(), chain.stationary());
        let k = self.settings.states;
        (0..k * k).map(|at| t[at] / rho[at % k]).collect()
    }

    /// Returns the learnt ratio at the figure's bias, [K, K], over the seeds of stationary sampling.
    pub(super) fn learnt_ratio(&self) -> Vec<Spread> {
        let of = || self.select(Sampling::Stationary, self.settings.figure_alpha);
        let k = self.settings.states;
        let entry = |at: usize| Spread::of(of().map(|one| one.learnt.ratio[at]));
        (0..k * k).filter_map(entry).collect()
    }

    /// Returns for each seed the mutual information, in nats, that the scores of stationary sampling have learnt.
    pub(super) fn learnt_information(&self, alpha: f64) -> Vec<f64> {
        let all = self.chain(alpha).mutual_information();
        let each = self.select(Sampling::Stationary, alpha);
        each.map(|one| all - one.final_excess()).collect()
    }

    /// Returns the biases of the drawn curves: the first of `alphas`, the figure's, and one halfway between.
    pub(super) fn shown_alphas(&self) -> Vec<f64> {
        let alphas = &self.settings.alphas;
        let is_figure = |alpha: &f64| *alpha == self.settings.figure_alpha;
        let figure = alphas.iter().position(is_figure).unwrap_or(0);
        let mut shown = vec![0, figure / 2, figure];
        shown.dedup();
        shown.into_iter().map(|at| alphas[at]).collect()
    }

    pub(super) fn tv_curve(&self, alpha: f64) -> Curve {
        let each: Vec<_> = self.select(Sampling::Stationary, alpha).collect();
        let updates = each.iter().take(1).flat_map(|one| &one.learnt.updates);
        let means = updates.enumerate().map(|(at, &update)| {
            let values = each.iter().map(|one| one.learnt.tv[at]);
            (update as f64, values.collect())
        });
        Curve::from_values(means, Band::Range)
    }

    /// Returns for each seed the rank correlation over alpha between 1 / gap and the updates until convergence.
    ///
    /// A training that never converges counts as one update more than a full training.
    pub(super) fn gap_correlations(&self, sampling: Sampling, measure: UpdatesTo) -> Vec<f64> {
        let of_seed = |seed: u32| {
            let all = self.trained.iter();
            let of_seed = all.filter(|one| one.sampling == sampling && one.seed == seed);
            let pairs = of_seed.map(|one| {
                let time = measure(one).unwrap_or(self.settings.updates + 1);
                // The gaps of mirror images differ by rounding alone, and are ties.
                (1.0 / rounded(one.chain.spectral_gap()), time as f64)
            });
            rank_correlation(&pairs.collect::<Vec<_>>())
        };
        (1..=self.settings.seeds).filter_map(of_seed).collect()
    }
}
