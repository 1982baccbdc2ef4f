//! Which transitions are drawn as anchors: what a rule of `replay.sampling` does, what of it is kept, and a file for each.
//! What can be an anchor is decided in `episodes`, and so is what is made of one.

pub(crate) mod prioritised;
mod sum_tree;
pub(super) mod uniform;

use driml_protocol::{Origin, PriorityUpdate};
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

use crate::{
    sampling::episodes::Window,
    storage::ring::{Link, Ring},
};

/// What became of the priorities that the learner has sent, in rows.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct PriorityCounts {
    /// Rows whose transition has the priority now.
    pub set: u64,
    /// Rows whose transition was overwritten meanwhile, or was drawn by an earlier life of the replay server.
    pub gone: u64,
    /// Rows of updates that had come before.
    pub repeated: u64,
}

/// A rule by which anchors are drawn. What only rules with priorities do has a default.
pub(crate) trait RowSampler: Send {
    /// A run of consecutive transitions of one stream was stored, those from `first` on; `link` was the first one's.
    fn stored(&mut self, _ring: &Ring, _first: u64, _link: Link) {}

    fn forget(&mut self, _ring: &Ring) {}

    /// Leaves the window of an anchor in `window`; false if there is none.
    fn draw(&mut self, ring: &Ring, rng: &mut ChaCha8Rng, window: &mut Window) -> bool;

    /// The probability with which each draw gives the anchor `index`; none where all anchors are equally likely.
    fn probability(&self, _index: u64) -> Option<f64> {
        None
    }

    /// Takes the priorities that the learner found; those drawn by another `origin` change nothing. On an error, which says why for a
    /// person, nothing has changed.
    fn update(
        &mut self,
        _ring: &Ring,
        _update: &PriorityUpdate,
        _origin: Origin,
    ) -> Result<(), String> {
        Err("priorities, in a run that draws uniformly".into())
    }

    /// What became of the priorities that came; none where there are no priorities.
    fn priority_counts(&self) -> Option<PriorityCounts> {
        None
    }

    /// What decides the next draws, beside what is held.
    fn state(&self, ring: &Ring) -> RowsState;

    /// Restores a state, except for transitions that are no longer held, or were not. `oldest` is the oldest that was held.
    fn restore(&mut self, ring: &Ring, oldest: u64, state: &RowsState);

    /// Panics at the first thing that is wrong. Slow: for tests.
    fn check_valid(&self, _ring: &Ring) {}
}

/// [`RowSampler::state`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) enum RowsState {
    /// Whether the valid anchors are listed: a draw then takes other numbers from the generator.
    Uniform { are_listed: bool },
    /// What cannot be told from the transitions held.
    Prioritised {
        /// The exponent of the masses.
        alpha: f64,
        highest: f64,
        /// Of each transition held, the oldest first, its mass.
        masses: Vec<f64>,
        /// The learner that the last update came from, and its number.
        last: Option<(u64, u64)>,
        counts: PriorityCounts,
    },
}

impl RowsState {
    pub(crate) const fn is_prioritised(&self) -> bool {
        matches!(self, Self::Prioritised { .. })
    }

    pub(crate) fn check(&self, held: u64) -> Result<(), &'static str> {
        let Self::Prioritised {
            alpha,
            highest,
            masses,
            ..
        } = self
        else {
            return Ok(());
        };
        let is_mass = |mass: &f64| mass.is_finite() && *mass >= 0.0;
        let are_masses = masses.iter().chain([highest]).all(is_mass);
        let is_alpha = (0.0..=1.0).contains(alpha);
        match masses.len() as u64 == held && are_masses && is_alpha {
            true => Ok(()),
            false => Err("a state with priorities of other transitions, or none that a run has"),
        }
    }
}
