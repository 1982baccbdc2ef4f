//! Checks of settings and saved arrays that both estimators use.

use std::ops::RangeInclusive;

use crate::{error::UpdateError, ranges::range_error};

/// Checks that each setting is in its range.
pub(super) fn check_ranges(all: &[(&str, f64, RangeInclusive<f64>)]) -> Result<(), UpdateError> {
    let mut all = all.iter();
    let why = all.find_map(|(name, value, range)| range_error(name, *value, range));
    why.map_or(Ok(()), |why| Err(UpdateError::Affinity(why)))
}

/// Checks the length of an array, and that its numbers are finite. Errors contain `name`.
pub(super) fn check_array(name: &str, array: &[f64], len: usize) -> Result<(), UpdateError> {
    if array.len() != len {
        let found = array.len();
        return Err(UpdateError::Affinity(format!(
            "{name} has {found} numbers, not {len}"
        )));
    }
    match array.iter().position(|value| !value.is_finite()) {
        Some(at) => Err(UpdateError::Affinity(format!(
            "{name} is not finite at index {at}"
        ))),
        None => Ok(()),
    }
}

/// Like [`check_array`], and checks that every number is a probability.
pub(super) fn check_probabilities(
    name: &str,
    array: &[f64],
    len: usize,
) -> Result<(), UpdateError> {
    check_array(name, array, len)?;
    let probability = |value: &f64| (0.0..=1.0 + 1e-6).contains(value);
    match array.iter().position(|value| !probability(value)) {
        Some(at) => Err(UpdateError::Affinity(format!(
            "{name} is not a probability at index {at}"
        ))),
        None => Ok(()),
    }
}
