//! All trainings of the grid, and what follows from them together.

use super::{
    chain::Chain,
    settings::Settings,
    training::{Learnt, Sampling},
};
use crate::stats::{Spread, rank_correlation};

/// One piece of the grid.
pub(super) struct Trained {
    pub(super) chain: Chain,
    pub(super) sampling: Sampling,
    pub(super) seed: u32,
    pub(super) learnt: Learnt,
}

impl Trained {
    pub(super) fn final_tv(&self) -> f64 {
        self.learnt.tv.last().copied().unwrap_or(f64::NAN)
    }

    pub(super) fn final_excess(&self) -> f64 {
        self.learnt.excess.last().copied().unwrap_or(f64::NAN)
    }
}

/// All trainings, and what was asked for.
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
        Chain {
            states: self.settings.states,
            alpha,
        }
    }

    /// Updates until a training's error is small; none where it never was.
    pub(super) fn time(&self, one: &Trained, measure: Measure) -> Option<u64> {
        let learnt = &one.learnt;
        match measure {
            Measure::Tv => learnt.updates_to(&learnt.tv, self.settings.tv_reached),
            Measure::Share => {
                let all = one.chain.mutual_information();
                learnt.updates_to(&learnt.excess, self.settings.share_reached * all)
            }
        }
    }

    /// Of each seed, the rank correlation over alpha between 1 / gap and the updates until the error is small.
    ///
    /// A training that never got there counts as one update more than the longest.
    pub(super) fn gap_correlations(&self, sampling: Sampling, measure: Measure) -> Option<Spread> {
        let of_seed = |seed: u32| {
            let one = self.trained.iter();
            let pairs: Vec<(f64, f64)> = one
                .filter(|one| one.sampling == sampling && one.seed == seed)
                .map(|one| {
                    let time = self.time(one, measure);
                    let time = time.unwrap_or(self.settings.updates + 1);
                    (1.0 / one.chain.spectral_gap(), time as f64)
                })
                .collect();
            rank_correlation(&pairs)
        };
        Spread::of((1..=self.settings.seeds).filter_map(of_seed))
    }
}

/// When a training counts as converged.
#[derive(Clone, Copy, PartialEq)]
pub(super) enum Measure {
    /// The law of the next state is near the true one, however near a blind guess is.
    Tv,
    /// Most of what there is to learn is learnt, however little that is.
    Share,
}
