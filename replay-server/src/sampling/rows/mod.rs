//! Which transitions are drawn as anchors: a file for each rule of `replay.sampling`.
//! What can be an anchor is decided in `episodes`; what is made of one, in `assemble`.

pub(crate) mod prioritised;
mod sum_tree;
mod uniform;

use driml_protocol::{Origin, PriorityUpdate, RunSpec, Sampling};
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

use super::episodes::{Episodes, Window};
use crate::{
    config::reach,
    storage::ring::{Link, Ring},
};
use prioritised::{Priorities, PriorityCounts, SavedPriorities};
use uniform::Uniform;

/// The transitions held, and the episodes that they form.
#[derive(Clone, Copy)]
pub(crate) struct Held<'a> {
    pub(crate) ring: &'a Ring,
    pub(crate) episodes: &'a Episodes,
}

/// A rule by which anchors are drawn.
pub(crate) trait RowSampler: Send {
    /// A run of consecutive transitions of one stream was stored, those from `first` on; `link` was the first one's.
    fn stored(&mut self, held: Held<'_>, first: u64, link: Link);

    /// Transitions were let go.
    fn forget(&mut self, ring: &Ring);

    /// Leaves the window of an anchor in `window`; false if there is none.
    fn draw(&mut self, held: Held<'_>, rng: &mut ChaCha8Rng, window: &mut Window) -> bool;

    /// The probability with which each draw gives the anchor `index`; none where all anchors are equally likely.
    fn probability(&self, index: u64) -> Option<f64>;

    /// Takes the priorities that the learner found; those drawn by another `origin` change nothing.
    ///
    /// # Errors
    /// A rule without priorities, or a transition that was never stored; the reason, for a person. Nothing has then changed.
    fn update(
        &mut self,
        ring: &Ring,
        update: &PriorityUpdate,
        origin: Origin,
    ) -> Result<(), String>;

    /// What became of the priorities that came; none where there are no priorities.
    fn priority_counts(&self) -> Option<PriorityCounts>;

    /// What decides the next draws, beside what is held.
    fn state(&self, ring: &Ring) -> RowsState;

    /// Takes back a state; of transitions that are no longer held, or were not, nothing. `oldest` is the oldest that was held.
    fn restore(&mut self, held: Held<'_>, oldest: u64, state: &RowsState, window: &mut Window);

    /// Panics at the first thing that is wrong. Slow: for tests.
    fn check_valid(&self, held: Held<'_>);
}

/// [`RowSampler::state`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) enum RowsState {
    /// Whether the valid anchors are listed: a draw then takes other numbers from the generator.
    Uniform {
        are_listed: bool,
    },
    Prioritised(SavedPriorities),
}

impl RowsState {
    /// Why this cannot be the state of a replay that held `held` transitions; none if it can.
    pub(crate) fn unfit(&self, held: u64) -> Option<&'static str> {
        match self {
            Self::Uniform { .. } => None,
            Self::Prioritised(saved) => saved.unfit(held),
        }
    }
}

/// The sampler of a ring of `capacity` transitions.
///
/// # Errors
/// The system refuses to reserve that much memory: the bytes asked for.
pub(crate) fn sampler(
    sampling: &Sampling,
    spec: &RunSpec,
    capacity: u64,
) -> Result<Box<dyn RowSampler>, u64> {
    Ok(match sampling {
        Sampling::Uniform => Box::new(Uniform::default()),
        Sampling::Prioritised { alpha, .. } => {
            Box::new(Priorities::new(*alpha, capacity, reach(spec))?)
        }
    })
}
