//! Checks settings against their ranges, and defines the ranges that several tables share.
//! The ranges are narrower than f64's because the computation is in f32.

use std::ops::RangeInclusive;

use crate::error::UpdateError;

/// Range of tau, the share of the online network in a move of a slow copy, whose parameters are f32.
pub(crate) const TAU_RANGE: RangeInclusive<f64> = 1e-5..=1.0;

/// Checks that a setting is in its range. NaN is outside every range.
pub(crate) fn check_range(
    name: &str,
    value: f64,
    range: RangeInclusive<f64>,
) -> Result<(), UpdateError> {
    range_error(name, value, &range).map_or(Ok(()), |why| Err(UpdateError::Settings(why)))
}

/// The error message for a setting that is outside its range.
pub(crate) fn range_error(name: &str, value: f64, range: &RangeInclusive<f64>) -> Option<String> {
    let (least, most) = (range.start(), range.end());
    let is_inside = range.contains(&value);
    (!is_inside).then(|| format!("{name} = {value:?} is not from {least:?} to {most:?}"))
}
