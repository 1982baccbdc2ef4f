//! The frames that a batch needs, each once: states of a row share them, and now and then rows do.
//! A frame is known by where the ring holds it: two that look the same are two.

use std::collections::{HashMap, hash_map::Entry};

use super::{assemble::RowStates, episodes::Episodes};
use crate::storage::ring::Ring;

/// The distinct frames of stacked states, in the order in which rows need them.
#[derive(Default)]
pub(crate) struct NeededFrames {
    /// Indices in the ring.
    indices: Vec<u64>,
    /// How many are needed by the rows up to each.
    row_ends: Vec<usize>,
    /// The frames of each state, oldest first, by their place among `indices`: row by row, in the order of [`RowStates::indices`].
    stacks: Vec<u32>,
    frame_stack: usize,
}

impl NeededFrames {
    pub(crate) fn of<'a>(
        ring: &Ring,
        episodes: &Episodes,
        rows: impl Iterator<Item = &'a RowStates>,
    ) -> Self {
        let mut this = Self {
            frame_stack: episodes.frame_stack(),
            ..Self::default()
        };
        let mut places = HashMap::new();
        for states in rows {
            for state in states.indices() {
                for index in episodes.stack(ring, state).frames() {
                    let place = match places.entry(index) {
                        Entry::Occupied(known) => *known.get(),
                        Entry::Vacant(new) => {
                            this.indices.push(index);
                            *new.insert(this.indices.len() as u32 - 1)
                        }
                    };
                    this.stacks.push(place);
                }
            }
            this.row_ends.push(this.indices.len());
        }
        this
    }

    pub(crate) const fn count(&self) -> usize {
        self.indices.len()
    }

    /// Those that `row` is the first to need, and their places.
    pub(crate) fn first_in(&self, row: usize) -> impl Iterator<Item = (u64, usize)> {
        let start = row.checked_sub(1).map_or(0, |before| self.row_ends[before]);
        let places = start..self.row_ends[row];
        self.indices[places.clone()].iter().copied().zip(places)
    }

    /// The places of each state's frames, oldest first.
    pub(crate) fn stacks(&self) -> impl Iterator<Item = &[u32]> {
        self.stacks.chunks_exact(self.frame_stack.max(1))
    }
}
