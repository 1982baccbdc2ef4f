//! Checks settings and saved numbers against their ranges, and defines the ranges that several tables share.
//! The ranges are narrower than f64's because the computation is in f32.

use std::ops::RangeInclusive;

use crate::error::{Result, UpdateError};

/// Range of tau, the share of the online network in a move of a slow copy, whose parameters are f32.
pub(crate) const TAU_RANGE: RangeInclusive<f64> = 1e-5..=1.0;
/// Range of an affinity's counts and means of squares.
pub(crate) const NOT_NEGATIVE: RangeInclusive<f64> = 0.0..=f64::MAX;
/// Range of a probability that was computed in f64.
pub(crate) const PROBABILITY: RangeInclusive<f64> = 0.0..=1.0 + 1e-6;

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

/// Checks the length of an affinity's array, and that each of its numbers is in `range`.
pub(crate) fn check_array(
    name: &str,
    array: &[f64],
    len: usize,
    range: RangeInclusive<f64>,
) -> Result<()> {
    if array.len() != len {
        let found = array.len();
        return Err(UpdateError::Affinity(format!(
            "{name} has {found} numbers, not {len}"
        )));
    }
    match array.iter().position(|number| !range.contains(number)) {
        Some(at) => check_ranges(&[(format!("{name}[{at}]").as_str(), array[at], range)]),
        None => Ok(()),
    }
}
