//! The alphabet of A: which raw actions count as one visible action.
//! It knows no games; presets give the tables.

use serde::{Deserialize, Serialize};

use crate::error::{Result, UpdateError};

/// A map from raw actions to visible actions, which are numbered without gaps.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Alphabet {
    /// Dense index of each raw action's visible action [n], below `len`.
    index: Vec<u8>,
    len: usize,
}

impl Alphabet {
    /// Creates the alphabet from a table raw action -> visible action.
    ///
    /// # Errors
    /// A table that is empty, longer than 255, or maps to an action that does not map to itself.
    pub fn new(map: &[u8]) -> Result<Self> {
        let count = map.len();
        if !(1..=255).contains(&count) {
            return Err(UpdateError::Affinity(format!(
                "an alphabet of {count} actions"
            )));
        }
        for (raw, &visible) in map.iter().enumerate() {
            if map.get(usize::from(visible)) != Some(&visible) {
                return Err(UpdateError::Affinity(format!(
                    "action {raw} maps to {visible}, which does not map to itself"
                )));
            }
        }
        let mut visible = map.to_vec();
        visible.sort_unstable();
        visible.dedup();
        // There are at most 255 visible actions, so an index fits a byte.
        let index = |v: &u8| visible.partition_point(|known| known < v) as u8;
        Ok(Self {
            index: map.iter().map(index).collect(),
            len: visible.len(),
        })
    }

    /// Creates the alphabet in which each of `num_actions` actions is visible.
    pub fn raw(num_actions: usize) -> Result<Self> {
        let map = (0..num_actions.min(256)).map(|action| action as u8);
        Self::new(&map.collect::<Vec<_>>())
    }

    /// Number of visible actions, m.
    #[allow(clippy::len_without_is_empty)] // Never empty.
    pub const fn len(&self) -> usize {
        self.len
    }

    /// Number of raw actions, n.
    pub fn num_actions(&self) -> usize {
        self.index.len()
    }

    /// Checks the invariants of [`Alphabet::new`]. An alphabet that was read from a file may violate them.
    pub(super) fn check_valid(&self) -> Result<()> {
        let mut used = self.index.clone();
        used.sort_unstable();
        used.dedup();
        let is_dense = used.into_iter().map(usize::from).eq(0..self.len);
        if is_dense && (1..=255).contains(&self.index.len()) {
            return Ok(());
        }
        Err(UpdateError::Affinity(format!(
            "an alphabet of {} visible actions over the raw ones {:?}",
            self.len, self.index
        )))
    }

    /// Maps pairs of raw actions to pairs of dense indices.
    pub(super) fn index_pairs(&self, pairs: &[(u8, u8)]) -> Result<Vec<(u8, u8)>> {
        let index = |action: u8| {
            let index = self.index.get(usize::from(action)).copied();
            let count = self.index.len();
            index
                .ok_or_else(|| UpdateError::Affinity(format!("action {action}; there are {count}")))
        };
        let pairs = pairs.iter();
        pairs.map(|&(i, j)| Ok((index(i)?, index(j)?))).collect()
    }

    /// Expands a matrix [m, m] by dense indices to one [n, n] by raw actions.
    pub(super) fn expand_matrix(&self, matrix: &[f64]) -> Vec<f32> {
        let entry = |&i: &u8, &j: &u8| matrix[usize::from(i) * self.len + usize::from(j)] as f32;
        let row = |i| self.index.iter().map(move |j| entry(i, j));
        self.index.iter().flat_map(row).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_visible_actions_are_numbered_without_gaps() {
        let alphabet = Alphabet::new(&[1, 1, 2, 4, 4]).unwrap();
        assert_eq!((alphabet.len(), alphabet.num_actions()), (3, 5));
        let pairs = alphabet.index_pairs(&[(0, 2), (3, 1)]).unwrap();
        assert_eq!(pairs, [(0, 1), (2, 0)]);
        let expanded = alphabet.expand_matrix(&[0.0, 1.0, 2.0, 10.0, 11.0, 12.0, 20.0, 21.0, 22.0]);
        assert_eq!(expanded[..5], [0.0, 0.0, 1.0, 2.0, 2.0]);
        assert_eq!(expanded[20..], [20.0, 20.0, 21.0, 22.0, 22.0]);
    }

    #[test]
    fn a_table_must_lead_to_actions_that_stand_for_themselves() {
        assert!(Alphabet::new(&[]).is_err());
        assert!(Alphabet::new(&[0, 2, 0]).is_err());
        assert!(Alphabet::new(&[0, 9]).is_err());
        assert!(Alphabet::raw(256).is_err());
    }
}
