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
const PAYS_ONE_IN: usize = 32;
const TASK_STATES: usize = 16;

/// The bytes of a state; `None` is a blank state, the placeholder for a missing one.
pub(crate) type State<'a> = Option<&'a [u8]>;

/// The input of a forward pass: all states, or only the distinct ones if that is faster.
pub(crate) struct PassInput<'a> {
    pub(crate) bytes: Cow<'a, [u8]>,
    /// For each state, its index in `bytes`; `None` if `bytes` holds all states.
    pub(crate) places: Option<Vec<u32>>,
}

impl<'a> PassInput<'a> {
    /// Makes the input from `states` of `state_bytes` bytes each. If `plane` has their total length, it holds the same states one after
    /// the other. `once` says whether equal states may be shared.
    pub(crate) fn of(
        states: &[State<'_>],
        plane: &'a [u8],
        state_bytes: usize,
        once: bool,
    ) -> Self {
        if once && let Some(distinct) = Distinct::of(states) {
            let firsts = distinct.firsts.iter().map(|&first| states[first]);
            return Self {
                bytes: Cow::Owned(one_after_another(firsts, state_bytes)),
                places: Some(distinct.places),
            };
        }
        let bytes = if plane.len() == states.len() * state_bytes {
            Cow::Borrowed(plane)
        } else {
            Cow::Owned(one_after_another(states.iter().copied(), state_bytes))
        };
        Self {
            bytes,
            places: None,
        }
    }
}

/// The distinct states of a pass, and for each state the distinct one that it equals.
#[derive(Clone, Debug, PartialEq, Eq)]
struct Distinct {
    /// For each distinct state, the index of its first occurrence in the pass, ascending.
    firsts: Vec<usize>,
    /// For each state, its index among the distinct states.
    places: Vec<u32>,
}

impl Distinct {
    /// Finds the distinct ones of `states`; `None` if too few repeat to be worth it.
    fn of(states: &[State<'_>]) -> Option<Self> {
        let sums = states.par_iter().with_min_len(TASK_STATES);
        let sums = sums.map(|state| state.map_or(0, crc32fast::hash));
        let sums: Vec<u32> = sums.collect();
        let mut distinct = Self {
            firsts: Vec::with_capacity(states.len()),
            places: Vec::with_capacity(states.len()),
        };
        // By checksum. If two different states have the same checksum, the second and its copies all count as distinct.
        let mut known_places = HashMap::with_capacity(states.len());
        for (at, (state, sum)) in states.iter().zip(sums).enumerate() {
            let new = distinct.firsts.len() as u32;
            let place = *known_places.entry(sum).or_insert(new);
            let known = place < new && states[distinct.firsts[place as usize]] == *state;
            if !known {
                distinct.firsts.push(at);
            }
            distinct.places.push(if known { place } else { new });
        }
        // The number of states that equal an earlier one.
        let repeats = states.len() - distinct.firsts.len();
        (repeats > 0 && repeats * PAYS_ONE_IN >= states.len()).then_some(distinct)
    }
}

/// Concatenates `states` of `state_bytes` bytes each; a blank state is all 0.
pub(crate) fn one_after_another<'a>(
    states: impl ExactSizeIterator<Item = State<'a>>,
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
    fn states_that_repeat_are_found() {
        let states: Vec<State<'_>> = [Some([1, 1]), None, Some([2, 2]), Some([1, 1]), None]
            .iter()
            .map(|state| state.as_ref().map(|it: &[u8; 2]| &it[..]))
            .collect();
        let input = PassInput::of(&states, &[], 2, true);
        assert_eq!(input.places.unwrap(), [0, 1, 2, 0, 1]);
        assert_eq!(*input.bytes, [1, 1, 0, 0, 2, 2]);
    }

    #[test]
    fn states_of_one_checksum_are_told_apart() {
        // "plumless" and "buckeroo" have the same CRC-32.
        let [a, b] = [b"plumless", b"buckeroo"].map(|it| Some(&it[..]));
        let states = [a, b, a, b];
        assert_eq!(crc32fast::hash(b"plumless"), crc32fast::hash(b"buckeroo"));
        let input = PassInput::of(&states, &[], 8, true);
        assert_eq!(input.places.unwrap(), [0, 1, 0, 2]);
        assert_eq!(*input.bytes, *b"plumlessbuckeroobuckeroo");
    }

    #[test]
    fn few_repeats_are_not_worth_it() {
        let numbers: Vec<u16> = (0..200).collect();
        let bytes: Vec<[u8; 2]> = numbers.iter().map(|number| number.to_le_bytes()).collect();
        let mut states: Vec<State<'_>> = bytes.iter().map(|bytes| Some(&bytes[..])).collect();
        assert_eq!(Distinct::of(&states), None);
        assert_eq!(Distinct::of(&[]), None);
        let enough = states.len().div_ceil(PAYS_ONE_IN);
        for repeated in 1..enough {
            states[100 + repeated] = states[0];
        }
        assert_eq!(Distinct::of(&states), None);
        states[150] = states[0];
        let distinct = Distinct::of(&states).unwrap();
        assert_eq!(states.len() - distinct.firsts.len(), enough);
    }
}
