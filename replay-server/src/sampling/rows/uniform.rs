//! Draws anchors, each valid one equally likely.
//! `episodes` decides which transitions are valid.

use rand::Rng;
use rand_chacha::ChaCha8Rng;

use super::{RowSampler, RowsState};
use crate::{
    sampling::episodes::{AnchorRules, Window},
    storage::ring::Ring,
};

/// Maximum draws that hit an invalid transition before all valid ones are listed instead. Either way the law is uniform.
const TRIES_MAX: u32 = 64;

/// Draws uniformly. Keeps the list of all valid anchors, once it was needed, as long as the ring does not change.
pub(crate) struct UniformSampler {
    rules: AnchorRules,
    anchors: Vec<u64>,
    /// Transitions that the ring had stored when `anchors` was listed; 0 before the first listing.
    listed_inserted: u64,
    listed_oldest: u64,
}

impl UniformSampler {
    pub(crate) const fn new(rules: AnchorRules) -> Self {
        Self {
            rules,
            anchors: Vec::new(),
            listed_inserted: 0,
            listed_oldest: 0,
        }
    }

    /// Whether `anchors` lists the anchors of the ring's current content.
    const fn is_list_current(&self, ring: &Ring) -> bool {
        self.listed_inserted == ring.inserted() && self.listed_oldest == ring.oldest()
    }

    fn list_anchors(&mut self, ring: &Ring) {
        let (rules, mut window) = (self.rules, Window::default());
        self.anchors.clear();
        let held = ring.oldest()..ring.inserted();
        self.anchors
            .extend(held.filter(|&t| rules.find_window(ring, t, &mut window)));
        (self.listed_inserted, self.listed_oldest) = (ring.inserted(), ring.oldest());
    }
}

impl RowSampler for UniformSampler {
    /// Draws by rejection; after [`TRIES_MAX`] misses from a list, which takes time proportional to the transitions held.
    fn draw(&mut self, ring: &Ring, rng: &mut ChaCha8Rng, window: &mut Window) -> bool {
        let rules = self.rules;
        if ring.oldest() == ring.inserted() {
            return false;
        }
        if !self.is_list_current(ring) {
            for _ in 0..TRIES_MAX {
                let t = rng.random_range(ring.oldest()..ring.inserted());
                if rules.find_window(ring, t, window) {
                    return true;
                }
            }
            self.list_anchors(ring);
        }
        if self.anchors.is_empty() {
            return false;
        }
        let t = self.anchors[rng.random_range(0..self.anchors.len())];
        let is_anchor = rules.find_window(ring, t, window);
        assert!(is_anchor, "{t} was valid and the ring has not changed");
        is_anchor
    }

    fn state(&self, ring: &Ring) -> RowsState {
        RowsState::Uniform {
            are_listed: self.is_list_current(ring),
        }
    }

    fn restore(&mut self, ring: &Ring, _: u64, state: &RowsState) {
        if *state == (RowsState::Uniform { are_listed: true }) {
            self.list_anchors(ring);
        }
    }
}
