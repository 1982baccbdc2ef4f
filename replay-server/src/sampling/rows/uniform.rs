//! Draws anchors, each valid one equally likely.
//! `episodes` decides which transitions are valid.

use rand::Rng;
use rand_chacha::ChaCha8Rng;

use super::{RowSampler, RowsState};
use crate::{
    sampling::episodes::{Episodes, Window},
    storage::ring::Ring,
};

/// Maximum draws that hit an invalid transition before all valid ones are listed instead. Either way the law is uniform.
const TRIES_MAX: u32 = 64;

/// Draws uniformly. Keeps the list of all valid anchors, once it was needed, as long as the ring does not change.
pub(crate) struct Uniform {
    episodes: Episodes,
    valid: Vec<u64>,
    /// Transitions that the ring had stored when `valid` was listed; 0 before the first listing.
    listed_at: u64,
    listed_from: u64,
}

impl Uniform {
    pub(crate) const fn new(episodes: Episodes) -> Self {
        Self {
            episodes,
            valid: Vec::new(),
            listed_at: 0,
            listed_from: 0,
        }
    }

    /// Whether `valid` lists the anchors of the ring's current content.
    const fn are_listed(&self, ring: &Ring) -> bool {
        self.listed_at == ring.inserted() && self.listed_from == ring.oldest()
    }

    fn list(&mut self, ring: &Ring) {
        let (episodes, mut window) = (self.episodes, Window::default());
        self.valid.clear();
        let held = ring.oldest()..ring.inserted();
        self.valid
            .extend(held.filter(|&t| episodes.walk(ring, t, &mut window)));
        (self.listed_at, self.listed_from) = (ring.inserted(), ring.oldest());
    }
}

impl RowSampler for Uniform {
    /// Draws by rejection; after [`TRIES_MAX`] misses from a list, which takes time proportional to the transitions held.
    fn draw(&mut self, ring: &Ring, rng: &mut ChaCha8Rng, window: &mut Window) -> bool {
        let episodes = self.episodes;
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
            self.list(ring);
        }
        if self.valid.is_empty() {
            return false;
        }
        let t = self.valid[rng.random_range(0..self.valid.len())];
        let valid = episodes.walk(ring, t, window);
        assert!(valid, "{t} was valid and the ring has not changed");
        valid
    }

    fn state(&self, ring: &Ring) -> RowsState {
        RowsState::Uniform {
            are_listed: self.are_listed(ring),
        }
    }

    fn restore(&mut self, ring: &Ring, _: u64, state: &RowsState) {
        if *state == (RowsState::Uniform { are_listed: true }) {
            self.list(ring);
        }
    }
}
