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
    if range.contains(&value) {
        return Ok(());
    }
    let (least, most) = range.into_inner();
    Err(UpdateError::Settings(format!(
        "{name} = {value:?} is not within {least:?} and {most:?}"
    )))
}
