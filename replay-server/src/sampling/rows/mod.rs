//! Draws anchors: the interface of the rules of `replay.sampling`, the state that is kept of them, and a file per rule.
//! `episodes` decides which transitions can be anchors, and makes the rows.

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

/// Counts, in rows, of what became of the priorities that the learner has sent.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct PriorityCounts {
    /// Rows whose priority was set.
    pub set: u64,
    /// Rows whose transition was overwritten before, or was drawn by an earlier incarnation of the replay server.
    pub gone: u64,
    /// Rows of repeated updates.
    pub repeated: u64,
}

/// A rule that draws anchors. Methods that only prioritised rules need have a default.
pub(crate) trait RowSampler: Send {
    /// Notes that consecutive transitions of one stream were stored, from index `first` on. `link` is the link of the first one.
    fn add_stored(&mut self, _ring: &Ring, _first: u64, _link: Link) {}

    fn forget_overwritten(&mut self, _ring: &Ring) {}

    /// Draws an anchor and writes its window to `window`. Returns false if no anchor exists.
    fn draw(&mut self, ring: &Ring, rng: &mut ChaCha8Rng, window: &mut Window) -> bool;

    /// Returns the probability that a draw gives the anchor `index`; `None` if all anchors are equally likely.
    fn probability(&self, _index: u64) -> Option<f64> {
        None
    }

    /// Sets the priorities that the learner found; rows that another `origin` drew change nothing. An error is the reason, for a person;
    /// nothing has changed then.
    fn set_priorities(
        &mut self,
        _ring: &Ring,
        _update: &PriorityUpdate,
        _origin: Origin,
    ) -> Result<(), String> {
        Err("priorities, in a run that draws uniformly".into())
    }

    /// Returns what became of the priorities received; `None` if the rule has no priorities.
    fn priority_counts(&self) -> Option<PriorityCounts> {
        None
    }

    /// Returns the state that determines the next draws, besides the transitions held.
    fn state(&self, ring: &Ring) -> RowsState;

    /// Restores a state, for transitions that were held then and are held now. `oldest` is the oldest that was held then.
    fn restore(&mut self, ring: &Ring, oldest: u64, state: &RowsState);

    /// Panics at the first inconsistency. Slow: for tests.
    fn check_valid(&self, _ring: &Ring) {}
}

/// The state of a [`RowSampler`] in a snapshot.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) enum RowsState {
    /// Whether the valid anchors are listed, as draws from the list consume random numbers differently.
    Uniform { are_listed: bool },
    /// The state that cannot be computed from the transitions held.
    Prioritised {
        /// The exponent of the masses.
        alpha: f64,
        highest: f64,
        /// The mass of each transition held, oldest first.
        masses: Vec<f64>,
        /// The learner that sent the last update, and the update's number.
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
            false => Err("the state has priorities of other transitions, or impossible ones"),
        }
    }
}
