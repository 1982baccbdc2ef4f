//! A sum tree: stores a number per place, gives their sum, and draws a place in proportion to its number, each in O(log n).
//! Source: Schaul et al. 2016, Prioritized Experience Replay, appendix B.2.1.
//!
//! If a number changes, each sum above it is computed again from its two children, never by adding the difference. So rounding errors do
//! not accumulate: the sums equal those of a new tree with the same numbers.

use rand::Rng;

use crate::storage::reserve;

/// Non-negative numbers at places `0..capacity`; 0 at first.
pub(super) struct SumTree {
    /// The number of places, rounded up to a power of two.
    leaves: usize,
    /// The root is at 1, the children of node i are at 2 i and 2 i + 1, and the numbers start at `leaves`.
    nodes: Vec<f64>,
}

impl SumTree {
    /// Creates a tree of zeros; memory is taken as places are used. An error holds the bytes that the system does not grant.
    pub(super) fn new(capacity: u64) -> Result<Self, u64> {
        let leaves = capacity.checked_next_power_of_two().unwrap_or(u64::MAX);
        // Asks first for the memory, as a failing `vec!` would abort the process. The zeros of `vec!` take memory only when used.
        drop(reserve::<f64>(leaves.saturating_mul(2))?);
        let leaves = leaves as usize;
        let nodes = vec![0.0; 2 * leaves];
        Ok(Self { leaves, nodes })
    }

    pub(super) fn total(&self) -> f64 {
        self.nodes[1]
    }

    pub(super) fn get(&self, place: usize) -> f64 {
        self.nodes[self.leaves + place]
    }

    /// Sets the number at `place`, which is finite and not negative.
    pub(super) fn set(&mut self, place: usize, number: f64) {
        debug_assert!(number.is_finite() && number >= 0.0, "{number}");
        let mut node = self.leaves + place;
        if self.nodes[node] == number {
            return;
        }
        self.nodes[node] = number;
        while node > 1 {
            node /= 2;
            self.nodes[node] = self.nodes[2 * node] + self.nodes[2 * node + 1];
        }
    }

    /// Draws a place with a probability of its share of the sum, never a place with number 0. `None` if the sum is 0.
    pub(super) fn draw(&self, rng: &mut impl Rng) -> Option<usize> {
        (self.total() > 0.0).then(|| self.place_at(rng.random()))
    }

    /// Returns the place at which the cumulative sum passes `share` of the total, which is not 0.
    fn place_at(&self, share: f64) -> usize {
        let mut left_over = share * self.total();
        let mut node = 1;
        while node < self.leaves {
            node *= 2;
            // Rounding must not lead into a subtree of zeros.
            if left_over >= self.nodes[node] && self.nodes[node + 1] > 0.0 {
                left_over -= self.nodes[node];
                node += 1;
            }
        }
        node - self.leaves
    }

    /// Checks every sum; panics at the first that is wrong. Slow: for tests.
    pub(super) fn check_valid(&self) {
        for node in 1..self.leaves {
            let sum = self.nodes[2 * node] + self.nodes[2 * node + 1];
            assert_eq!(self.nodes[node], sum, "node {node}");
        }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use rand::{Rng, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    use super::*;

    proptest! {
        /// For numbers of any size, no draw gives a zero, and the sums do not drift from those of a new tree.
        #[test]
        fn never_draws_a_zero_and_never_drifts(
            numbers in prop::collection::vec(prop_oneof![Just(0.0), 1e-12f64..1e12, Just(1e38)], 1..70),
            seed in any::<u64>(),
        ) {
            let mut rng = ChaCha8Rng::seed_from_u64(seed);
            let mut tree = SumTree::new(numbers.len() as u64).unwrap();
            for _ in 0..20 {
                for place in 0..numbers.len() {
                    tree.set(place, rng.random_range(0.0..1e30));
                }
            }
            let mut fresh = SumTree::new(numbers.len() as u64).unwrap();
            for (place, &number) in numbers.iter().enumerate() {
                tree.set(place, number);
                fresh.set(place, number);
            }
            prop_assert_eq!(&tree.nodes, &fresh.nodes);
            for _ in 0..50 {
                match tree.draw(&mut rng) {
                    Some(place) => prop_assert!(numbers[place] > 0.0),
                    None => prop_assert!(numbers.iter().all(|&number| number == 0.0)),
                }
            }
            for edge in [0.0, 1.0 - f64::EPSILON] {
                prop_assert!(tree.total() == 0.0 || numbers[tree.place_at(edge)] > 0.0);
            }
        }
    }

    #[test]
    fn memory_that_is_not_there_is_an_error() {
        assert!(SumTree::new(1 << 50).is_err_and(|bytes| bytes == 1 << 54));
        assert!(SumTree::new(u64::MAX).is_err());
    }
}
