//! A sum tree: numbers by place, their sum, and a place drawn in proportion to its number, each in O(log n).
//! Source: Schaul et al. 2016, Prioritized Experience Replay, appendix B.2.1.
//!
//! Every sum is computed anew from its two parts when one of them changes, never by adding a difference: it is what it would be had
//! all numbers been set at once, however often they have changed.

use rand::Rng;

use crate::storage::reserve;

/// Numbers that are not negative, at places `0..capacity`; 0 at first.
pub(super) struct SumTree {
    /// Places, rounded up to a power of two.
    leaves: usize,
    /// The root at 1, the parts of node i at 2 i and 2 i + 1, the numbers from `leaves` on.
    nodes: Vec<f64>,
}

impl SumTree {
    /// All 0. Its memory is taken as places are used. An error gives the bytes that the system refuses to reserve.
    pub(super) fn new(capacity: u64) -> Result<Self, u64> {
        let leaves = capacity.checked_next_power_of_two().unwrap_or(u64::MAX);
        // Zeros that come from the system are not touched; whether it grants them is asked first, as that ends no process.
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

    /// A place, each as likely as its share of the sum, those of number 0 never; none if the sum is 0.
    pub(super) fn draw(&self, rng: &mut impl Rng) -> Option<usize> {
        (self.total() > 0.0).then(|| self.place(rng.random()))
    }

    /// The place at which so large a share of the sum, which is not 0, has been passed.
    fn place(&self, share: f64) -> usize {
        let mut left_over = share * self.total();
        let mut node = 1;
        while node < self.leaves {
            node *= 2;
            // Rounding must not lead where there is nothing.
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
        /// Numbers of any size: what is drawn is never a 0, and sums do not drift from those of a tree that is new.
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
                prop_assert!(tree.total() == 0.0 || numbers[tree.place(edge)] > 0.0);
            }
        }
    }

    #[test]
    fn memory_that_is_not_there_is_an_error() {
        assert!(SumTree::new(1 << 50).is_err_and(|bytes| bytes == 1 << 54));
        assert!(SumTree::new(u64::MAX).is_err());
    }
}
