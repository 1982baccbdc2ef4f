//! Prioritised sampling, proportional rule: the probability of an anchor is its priority to the power of alpha, over the sum of all.
//! It does not weight rows (the learner does, by the probabilities in a batch) and computes no priority.
//!
//! Source: Schaul et al. 2016, Prioritized Experience Replay; Hessel et al. 2018, Rainbow, where a priority is the row's C51 loss.
//! A transition that was never learned from has the highest priority seen, as in both. Rows are drawn with replacement, each from all
//! anchors and not from one of B strata, so every row follows the law.

use std::collections::{BTreeMap, VecDeque};

use driml_protocol::{Origin, PriorityPart, PriorityUpdate};
use rand_chacha::ChaCha8Rng;

use super::{PriorityCounts, RowSampler, RowsState, sum_tree::SumTree};
use crate::{
    sampling::episodes::{AnchorRules, Window},
    storage::ring::{Link, Ring},
};

/// The constant added to a priority before it is raised to alpha, so that each transition can still be drawn. Dopamine adds the same to
/// the loss (Castro et al. 2018).
pub const PRIORITY_MIN: f64 = 1e-10;

/// Maximum relative error of a row's probability in a batch: half of an f32's last place. Probabilities below 1.2e-38 are sent as 1.2e-38.
pub const PROBABILITY_ERROR: f64 = 6.1e-8;

/// The highest priority before the first update, as in Dopamine. Any value would do, as all priorities are equal then.
const INITIAL_PRIORITY: f64 = 1.0;

/// The priorities of those transitions held that can be anchors.
pub(crate) struct PrioritisedSampler {
    alpha: f64,
    capacity: u64,
    rules: AnchorRules,
    /// (priority + [`PRIORITY_MIN`])^alpha by slot, the index modulo the capacity; 0 for transitions that cannot be anchors.
    masses: SumTree,
    highest: f64,
    /// Transitions before this one have mass 0.
    oldest: u64,
    /// Transitions that still need steps after them, in the order of their episode. The key is the newest transition of the stream.
    incomplete: BTreeMap<u64, VecDeque<u64>>,
    /// The learner that sent the last update, and the update's number.
    last: Option<(u64, u64)>,
    counts: PriorityCounts,
}

impl PrioritisedSampler {
    /// Creates the priorities of an empty ring of `capacity` transitions. An error holds the bytes that the system does not grant.
    pub(crate) fn new(alpha: f64, capacity: u64, rules: AnchorRules) -> Result<Self, u64> {
        Ok(Self {
            alpha,
            capacity,
            rules,
            masses: SumTree::new(capacity)?,
            highest: INITIAL_PRIORITY,
            oldest: 0,
            incomplete: BTreeMap::new(),
            last: None,
            counts: PriorityCounts::default(),
        })
    }

    fn slot(&self, index: u64) -> usize {
        (index % self.capacity) as usize
    }

    fn mass(&self, priority: f64) -> f64 {
        (priority + PRIORITY_MIN).powf(self.alpha)
    }

    /// Converts a `mass` from another `alpha`. If that was 0, all masses were equal, and the priority becomes `highest`.
    fn convert_mass(&self, mass: f64, alpha: f64, highest: f64) -> f64 {
        if mass == 0.0 || alpha == self.alpha {
            return mass;
        }
        match alpha {
            0.0 => self.mass(highest),
            _ => mass
                .powf(self.alpha / alpha)
                .clamp(PRIORITY_MIN, f32::MAX.into()),
        }
    }

    /// Sets the priorities of rows that were drawn from `ring`. If a transition was drawn twice, its last priority counts.
    fn set_part(&mut self, ring: &Ring, part: &PriorityPart) {
        for (&index, &priority) in part.transitions.iter().zip(&part.priorities) {
            let slot = self.slot(index);
            let is_held = (ring.oldest()..ring.inserted()).contains(&index);
            // Only anchors have a priority.
            if !is_held || self.masses.get(slot) == 0.0 {
                self.counts.gone += 1;
                continue;
            }
            let priority = f64::from(priority);
            self.highest = self.highest.max(priority);
            self.masses.set(slot, self.mass(priority));
            self.counts.set += 1;
        }
    }
}

impl RowSampler for PrioritisedSampler {
    /// Gives the highest priority seen to each transition that can be an anchor now.
    fn add_stored(&mut self, ring: &Ring, first: u64, link: Link) {
        self.forget_overwritten(ring);
        let waiting = link.previous().and_then(|it| self.incomplete.remove(&it));
        let mut waiting = waiting.unwrap_or_default();
        let mass = self.mass(self.highest);
        for index in first.max(ring.oldest())..ring.inserted() {
            waiting.push_back(index);
            let complete = if ring.step(index).end.is_episode_end() {
                waiting.len()
            } else {
                waiting.len().saturating_sub(self.rules.lookahead_steps)
            };
            for anchor in waiting.drain(..complete) {
                if anchor >= ring.oldest() && self.rules.has_return_and_stack(ring, anchor) {
                    self.masses.set(self.slot(anchor), mass);
                }
            }
        }
        if !waiting.is_empty() {
            self.incomplete.insert(ring.inserted() - 1, waiting);
        }
    }

    /// Zeroes the masses of transitions that are no longer held.
    fn forget_overwritten(&mut self, ring: &Ring) {
        let oldest = ring.oldest();
        let from = self.oldest.max(oldest.saturating_sub(self.capacity));
        for index in from..oldest {
            self.masses.set(self.slot(index), 0.0);
        }
        self.oldest = oldest;
        // Streams that stopped in the middle of an episode.
        while let Some(stream) = self.incomplete.first_entry()
            && *stream.key() < oldest
        {
            stream.remove();
        }
    }

    fn draw(&mut self, ring: &Ring, rng: &mut ChaCha8Rng, window: &mut Window) -> bool {
        while let Some(slot) = self.masses.draw(rng) {
            let newest = ring.inserted() - 1;
            let behind = (self.slot(newest) + self.capacity as usize - slot) as u64 % self.capacity;
            if self.rules.find_window(ring, newest - behind, window) {
                return true;
            }
            // The first frame of its stack was overwritten: it can never be an anchor again.
            self.masses.set(slot, 0.0);
        }
        false
    }

    fn probability(&self, index: u64) -> Option<f64> {
        Some(self.masses.get(self.slot(index)) / self.masses.total())
    }

    /// Only counts rows of a repeated update, and rows whose transition was overwritten. Ignores rows of other shards.
    fn set_priorities(
        &mut self,
        ring: &Ring,
        update: &PriorityUpdate,
        origin: Origin,
    ) -> Result<(), String> {
        let own_parts = || {
            let parts = update.parts.iter();
            parts.filter(|part| part.origin.shard == origin.shard)
        };
        let stored = ring.inserted();
        let drawn_here = own_parts().filter(|part| part.origin == origin);
        for index in drawn_here.flat_map(|part| &part.transitions) {
            if *index >= stored {
                return Err(format!(
                    "a priority of transition {index}, where {stored} were stored"
                ));
            }
        }
        let (learner, number) = (update.learner, update.number);
        let last = self.last;
        let is_new = last.is_none_or(|last| last.0 != learner || number > last.1);
        if is_new {
            self.last = Some((learner, number));
        }
        for part in own_parts() {
            let rows = part.transitions.len() as u64;
            if !is_new {
                self.counts.repeated += rows;
            } else if part.origin == origin {
                self.set_part(ring, part);
            } else {
                self.counts.gone += rows;
            }
        }
        Ok(())
    }

    fn priority_counts(&self) -> Option<PriorityCounts> {
        Some(self.counts)
    }

    fn state(&self, ring: &Ring) -> RowsState {
        let held = ring.oldest()..ring.inserted();
        RowsState::Prioritised {
            alpha: self.alpha,
            highest: self.highest,
            masses: held.map(|i| self.masses.get(self.slot(i))).collect(),
            last: self.last,
            counts: self.counts,
        }
    }

    fn restore(&mut self, ring: &Ring, oldest: u64, state: &RowsState) {
        // The run drew uniformly before: each transition keeps the highest priority.
        let RowsState::Prioritised {
            alpha,
            highest,
            masses,
            last,
            counts,
        } = state
        else {
            return;
        };
        for (index, &mass) in (oldest..).zip(masses) {
            let slot = self.slot(index);
            if !(ring.oldest()..ring.inserted()).contains(&index) {
                continue;
            }
            // A transition whose following steps are gone cannot be an anchor any more.
            let lacks_steps =
                self.masses.get(slot) == 0.0 && self.rules.has_return_and_stack(ring, index);
            if !lacks_steps {
                let mass = self.convert_mass(mass, *alpha, *highest);
                self.masses.set(slot, mass);
            }
        }
        (self.highest, self.last, self.counts) = (*highest, *last, *counts);
    }

    /// Checks that exactly the anchors have a mass, apart from transitions whose frame stack was overwritten in part.
    fn check_valid(&self, ring: &Ring) {
        self.masses.check_valid();
        let rules = self.rules;
        let mut window = Window::default();
        let mut anchors = 0;
        for index in ring.oldest()..ring.inserted() {
            let mass = self.masses.get(self.slot(index));
            let is_anchor = rules.find_window(ring, index, &mut window);
            assert!(!is_anchor || mass > 0.0, "{index} is an anchor");
            let lacks_steps = !is_anchor && mass != 0.0 && rules.has_return_and_stack(ring, index);
            assert!(!lacks_steps, "{index} lacks steps");
            anchors += usize::from(mass > 0.0);
        }
        let with_mass = (0..self.capacity as usize).filter(|&slot| self.masses.get(slot) > 0.0);
        assert_eq!(with_mass.count(), anchors, "what is not held has no mass");
    }
}
