//! Checks settings and saved numbers against their ranges, and defines the ranges that several tables share.
//! The ranges are narrower than f64's because the computation is in f32.

use std::ops::RangeInclusive;

use crate::error::{Result, UpdateError};

/// Range of tau, the share of the online network in a move of a slow copy, whose parameters are f32.
pub(crate) const TAU_RANGE: RangeInclusive<f64> = 1e-5..=1.0;

/// Checks that a setting is in its range. NaN is outside every range.
pub(crate) fn check_range(name: &str, value: f64, range: RangeInclusive<f64>) -> Result<()> {
    range_error(name, value, &range).map_or(Ok(()), |why| Err(UpdateError::Settings(why)))
}

/// The error message for a setting that is outside its range.
fn range_error(name: &str, value: f64, range: &RangeInclusive<f64>) -> Option<String> {
    let (least, most) = (range.start(), range.end());
    let is_inside = range.contains(&value);
    (!is_inside).then(|| format!("{name} = {value:?} is not from {least:?} to {most:?}"))
}

/// Checks that each setting of an affinity is in its range.
pub(crate) fn check_ranges(all: &[(&str, f64, RangeInclusive<f64>)]) -> Result<()> {
    let mut all = all.iter();
    let why = all.find_map(|(name, value, range)| range_error(name, *value, range));
    why.map_or(Ok(()), |why| Err(UpdateError::Affinity(why)))
}

/// Checks the length of an affinity's array, and that its numbers are finite. Errors contain `name`.
pub(crate) fn check_array(name: &str, array: &[f64], len: usize) -> Result<()> {
    if array.len() != len {
        let found = array.len();
        return Err(UpdateError::Affinity(format!(
            "{name} has {found} numbers, not {len}"
        )));
    }
    check_numbers(name, array, "not finite", f64::is_finite)
}

/// Checks that each number of an affinity's array `is_right`. The error says that `name` is `wrong`, and where.
pub(crate) fn check_numbers(
    name: &str,
    array: &[f64],
    wrong: &str,
    is_right: fn(f64) -> bool,
) -> Result<()> {
    match array.iter().position(|&number| !is_right(number)) {
        Some(at) => Err(UpdateError::Affinity(format!(
            "{name} is {wrong} at index {at}"
        ))),
        None => Ok(()),
    }
}

/// Like [`check_array`], and checks that every number is a probability.
pub(crate) fn check_probabilities(name: &str, array: &[f64], len: usize) -> Result<()> {
    check_array(name, array, len)?;
    let is_probability = |number: f64| (0.0..=1.0 + 1e-6).contains(&number);
    check_numbers(name, array, "not a probability", is_probability)
}
