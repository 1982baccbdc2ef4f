//! Differences as the page of a trade-off says them.

use crate::stats::{Difference, Interval};

/// A difference, with its sign.
pub(super) fn signed(it: &Difference) -> String {
    let Interval { mean, ends } = it.interval;
    match ends {
        None => format!("{mean:+.2} (one seed)"),
        Some((low, high)) => format!("{mean:+.2} [{low:+.2}, {high:+.2}]"),
    }
}

/// What a difference says.
pub(super) fn verdict(difference: &Difference) -> &'static str {
    match (difference.is_apart, difference.interval.mean > 0.0) {
        (false, _) => "",
        (true, true) => ", better than its base",
        (true, false) => ", worse than its base",
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::stats::difference;

    #[test]
    fn a_difference_is_put_into_words() {
        let base = [0.0, 0.01, 0.02, 0.03];
        let said = |values: &[f64]| {
            let found = difference(&base, values).unwrap();
            format!("{}{}", signed(&found), verdict(&found))
        };
        let better = said(&[1.0, 1.1, 1.2, 1.3]);
        assert!(better.ends_with("], better than its base"), "{better}");
        let worse = said(&[-1.0, -1.1, -1.2, -1.3]);
        assert!(worse.ends_with("], worse than its base"), "{worse}");
        assert!(said(&[-1.0, 1.0, 0.0]).ends_with(']'));
        assert_eq!(said(&[1.0]), "+0.98 (one seed)");
    }
}
