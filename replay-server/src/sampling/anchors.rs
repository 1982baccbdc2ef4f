//! Draws anchors, each valid one equally likely.
//! It does not decide what is valid: that is `episodes`.

use rand::Rng;

use super::episodes::{Episodes, Window};
use crate::storage::ring::Ring;

/// Draws that may hit an invalid transition before all valid ones are listed instead; either way the law is uniform.
const TRIES_MAX: u32 = 64;

/// The list of all valid anchors, kept for as long as the ring does not change.
#[derive(Default)]
pub(crate) struct Anchors {
    valid: Vec<u64>,
    /// Transitions the ring had stored when `valid` was listed; 0 before the first.
    listed_at: u64,
    /// The oldest one that it held then.
    listed_from: u64,
}

impl Anchors {
    /// Leaves the window of an anchor, uniform over the valid ones, in `window`; false if there is none.
    ///
    /// By rejection; after [`TRIES_MAX`] misses by listing, which takes time proportional to the transitions held.
    pub(crate) fn draw(
        &mut self,
        ring: &Ring,
        episodes: &Episodes,
        rng: &mut impl Rng,
        window: &mut Window,
    ) -> bool {
        if ring.oldest() == ring.inserted() {
            return false;
        }
        if !self.are_listed(ring) {
            for _ in 0..TRIES_MAX {
                let t = rng.random_range(ring.oldest()..ring.inserted());
                if episodes.walk(ring, t, window) {
                    return true;
                }
            }
            self.list(ring, episodes, window);
        }
        if self.valid.is_empty() {
            return false;
        }
        let t = self.valid[rng.random_range(0..self.valid.len())];
        let valid = episodes.walk(ring, t, window);
        assert!(valid, "{t} was valid and the ring has not changed");
        valid
    }

    /// Whether the list is that of the ring as it is.
    pub(crate) const fn are_listed(&self, ring: &Ring) -> bool {
        self.listed_at == ring.inserted() && self.listed_from == ring.oldest()
    }

    /// Lists the valid anchors.
    pub(crate) fn list(&mut self, ring: &Ring, episodes: &Episodes, window: &mut Window) {
        self.valid.clear();
        let held = ring.oldest()..ring.inserted();
        self.valid
            .extend(held.filter(|&t| episodes.walk(ring, t, window)));
        (self.listed_at, self.listed_from) = (ring.inserted(), ring.oldest());
    }
}
