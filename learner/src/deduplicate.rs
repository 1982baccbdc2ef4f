//! States of a pass that are equal to another of it: found by a checksum that a comparison confirms, and passed through a network once.
//! It computes nothing of the states.
//!
//! Where a scene stands still, half of a batch's states are there twice. Each result of a row has the same bits whatever the rows
//! beside it, so what is computed once is what would be computed each time. A state's gradient is then the sum of its copies',
//! first to last, where the products would have summed them among others: gradients differ in their last bits, and are the same
//! for any number of threads.

use std::{borrow::Cow, collections::HashMap};

use rayon::prelude::*;

/// A pass is made shorter where at least one of this many states repeats another: below, what is saved is less than what it costs
/// to pick states out and to hand their features round.
const PAYS_ONE_IN: usize = 32;
const TASK_STATES: usize = 16;

/// The bytes of a state; none of a blank one, which stands where there is no state.
pub(crate) type State<'a> = Option<&'a [u8]>;

/// The states of a pass as a network takes them: all, or the distinct ones alone where that pays.
pub(crate) struct PassInput<'a> {
    pub(crate) bytes: Cow<'a, [u8]>,
    /// Of each state its place among those that pass; none where all do.
    pub(crate) places: Option<Vec<u32>>,
}

impl<'a> PassInput<'a> {
    /// That of `states` of this length; `plane`, if it is as long as all of them, holds them one after the other. `once` says whether equal
    /// ones may pass once.
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

/// The distinct states of a pass, and which of them each of its states is.
#[derive(Clone, Debug, PartialEq, Eq)]
struct Distinct {
    /// Of each distinct state its first place in the pass, ascending.
    firsts: Vec<usize>,
    /// Of each state its place among the distinct ones.
    places: Vec<u32>,
}

impl Distinct {
    /// That of `states`, if it pays to compute the distinct ones alone.
    fn of(states: &[State<'_>]) -> Option<Self> {
        let sums = states.par_iter().with_min_len(TASK_STATES);
        let sums = sums.map(|state| state.map_or(0, crc32fast::hash));
        let sums: Vec<u32> = sums.collect();
        let mut distinct = Self {
            firsts: Vec::with_capacity(states.len()),
            places: Vec::with_capacity(states.len()),
        };
        // By checksum. Of two different states with the same checksum, the second never counts as a repeat, nor do its copies.
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
        // States that are equal to one before them.
        let repeats = states.len() - distinct.firsts.len();
        (repeats > 0 && repeats * PAYS_ONE_IN >= states.len()).then_some(distinct)
    }
}

/// The bytes of `states` of this length.
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
