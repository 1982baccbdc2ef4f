//! Finds equal states of a forward pass, by a checksum that a comparison confirms, so that a network computes each of them once.
//! It computes no features.
//!
//! Where a scene stands still, half of a batch's states occur twice. The result of a row has the same bits whatever the other rows
//! are, so that sharing it changes no result of the forward pass. The gradient of a shared state is the sum over its copies, first to
//! last; otherwise, the matrix products sum the copies among other rows. Gradients therefore differ in their last bits, but they are
//! the same for any number of threads.

use std::{borrow::Cow, collections::HashMap};

use rayon::prelude::*;

/// Equal states are shared if at least one state in this many repeats another. With fewer repeats, selecting states and copying
/// their features costs more than the shorter pass saves.
const STATES_PER_REPEAT_MAX: usize = 32;
const STATES_PER_TASK: usize = 16;

/// The bytes of a state; `None` is a blank state, the placeholder for a missing one.
pub(crate) type StateBytes<'a> = Option<&'a [u8]>;

/// The input of a forward pass: all states, or only the distinct ones if that is faster.
pub(crate) struct PassInput<'a> {
    pub(crate) bytes: Cow<'a, [u8]>,
    /// For each state, its index in `bytes`; `None` if `bytes` holds all states.
    pub(crate) indices: Option<Vec<u32>>,
}

impl<'a> PassInput<'a> {
    /// Makes the input from `states` of `state_bytes` bytes each. If `concatenated` has their total length, it holds the same states one
    /// after the other. `deduplicate` says whether equal states may be shared.
    pub(crate) fn new(
        states: &[StateBytes<'_>],
        concatenated: &'a [u8],
        state_bytes: usize,
        deduplicate: bool,
    ) -> Self {
        if deduplicate && let Some(distinct) = DistinctStates::find(states) {
            let first_indices = distinct.first_indices.iter().map(|&first| states[first]);
            return Self {
                bytes: Cow::Owned(concatenate(first_indices, state_bytes)),
                indices: Some(distinct.indices),
            };
        }
        let bytes = if concatenated.len() == states.len() * state_bytes {
            Cow::Borrowed(concatenated)
        } else {
            Cow::Owned(concatenate(states.iter().copied(), state_bytes))
        };
        Self {
            bytes,
            indices: None,
        }
    }
}

/// The distinct states of a pass, and for each state the distinct one that it equals.
#[derive(Clone, Debug, PartialEq, Eq)]
struct DistinctStates {
    /// For each distinct state, the index of its first occurrence in the pass, ascending.
    first_indices: Vec<usize>,
    /// For each state, its index among the distinct states.
    indices: Vec<u32>,
}

impl DistinctStates {
    /// Finds the distinct ones of `states`; `None` if too few repeat to be worth it.
    fn find(states: &[StateBytes<'_>]) -> Option<Self> {
        let sums = states.par_iter().with_min_len(STATES_PER_TASK);
        let sums = sums.map(|state| state.map_or(0, crc32fast::hash));
        let sums: Vec<u32> = sums.collect();
        let mut distinct = Self {
            first_indices: Vec::with_capacity(states.len()),
            indices: Vec::with_capacity(states.len()),
        };
        // By checksum. If two different states have the same checksum, the second and its copies all count as distinct.
        let mut index_by_sum = HashMap::with_capacity(states.len());
        for (position, (state, sum)) in states.iter().zip(sums).enumerate() {
            let next = distinct.first_indices.len() as u32;
            let index = *index_by_sum.entry(sum).or_insert(next);
            let is_known = index < next && states[distinct.first_indices[index as usize]] == *state;
            if !is_known {
                distinct.first_indices.push(position);
            }
            distinct.indices.push(if is_known { index } else { next });
        }
        // The number of states that equal an earlier one.
        let repeats = states.len() - distinct.first_indices.len();
        (repeats > 0 && repeats * STATES_PER_REPEAT_MAX >= states.len()).then_some(distinct)
    }
}

/// Concatenates `states` of `state_bytes` bytes each; a blank state is all 0.
pub(crate) fn concatenate<'a>(
    states: impl ExactSizeIterator<Item = StateBytes<'a>>,
    state_bytes: usize,
) -> Vec<u8> {
    let mut bytes = Vec::with_capacity(states.len() * state_bytes);
    for state in states {
        match state {
            Some(state) => bytes.extend_from_slice(state),
            None => bytes.resize(bytes.len() + state_bytes, 0),
        }
    }
    bytes
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn states_that_repeat_are_found_and_those_of_one_checksum_are_told_apart() {
        // "plumless" and "buckeroo" have the same CRC-32.
        let [a, b] = [b"plumless", b"buckeroo"].map(|it| Some(&it[..]));
        assert_eq!(crc32fast::hash(b"plumless"), crc32fast::hash(b"buckeroo"));
        let input = PassInput::new(&[a, None, b, a, b, None], &[], 8, true);
        assert_eq!(input.indices.unwrap(), [0, 1, 2, 0, 3, 1]);
        assert_eq!(*input.bytes, *b"plumless\0\0\0\0\0\0\0\0buckeroobuckeroo");
    }

    #[test]
    fn few_repeats_are_not_worth_it() {
        let numbers: Vec<u16> = (0..200).collect();
        let bytes: Vec<[u8; 2]> = numbers.iter().map(|number| number.to_le_bytes()).collect();
        let mut states: Vec<StateBytes<'_>> = bytes.iter().map(|bytes| Some(&bytes[..])).collect();
        assert_eq!(DistinctStates::find(&states), None);
        assert_eq!(DistinctStates::find(&[]), None);
        let enough = states.len().div_ceil(STATES_PER_REPEAT_MAX);
        for repeated in 1..enough {
            states[100 + repeated] = states[0];
        }
        assert_eq!(DistinctStates::find(&states), None);
        states[150] = states[0];
        let distinct = DistinctStates::find(&states).unwrap();
        assert_eq!(states.len() - distinct.first_indices.len(), enough);
    }
}
