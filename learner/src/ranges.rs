//! How a setting that has a range is checked, and the ranges that more than one table has.
//! They are narrower than f64: what is computed is f32.

use std::ops::RangeInclusive;

use crate::error::UpdateError;

/// Shares of the online network that a slow copy in f32 follows.
pub(crate) const TAU: RangeInclusive<f64> = 1e-5..=1.0;

/// Checks that a setting is in its range; NaN is not.
pub(crate) fn check_range(
    name: &str,
    value: f64,
    range: RangeInclusive<f64>,
) -> Result<(), UpdateError> {
    outside(name, value, &range).map_or(Ok(()), |why| Err(UpdateError::Settings(why)))
}

/// What is wrong with a setting, if it is not in its range.
pub(crate) fn outside(name: &str, value: f64, range: &RangeInclusive<f64>) -> Option<String> {
    let (least, most) = (range.start(), range.end());
    let is_inside = range.contains(&value);
    (!is_inside).then(|| format!("{name} = {value:?} is not from {least:?} to {most:?}"))
}
