//! Times and sizes in human-readable form.

use std::time::Duration;

/// A time in two units at most, such as `17 min 23 s`.
pub fn duration(time: Duration) -> String {
    let seconds = time.as_secs();
    match seconds {
        0..60 => format!("{seconds} s"),
        60..3600 => format!("{} min {} s", seconds / 60, seconds % 60),
        3600..86_400 => format!("{} h {} min", seconds / 3600, seconds % 3600 / 60),
        _ => format!("{} d {} h", seconds / 86_400, seconds % 86_400 / 3600),
    }
}

/// A time in one unit, for what is known roughly, such as `25 min`.
pub fn rough_duration(seconds: f64) -> String {
    if seconds < 99.5 {
        format!("{seconds:.0} s")
    } else if seconds < 5_970.0 {
        format!("{:.0} min", seconds / 60.0)
    } else {
        format!("{:.1} h", seconds / 3_600.0)
    }
}

/// A size in GiB, with one decimal.
pub fn gib(bytes: u64) -> String {
    format!("{:.1} GiB", bytes as f64 / f64::from(1 << 30))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn times_have_two_units_at_most() {
        let texts = [5, 65, 3_660, 90_000].map(|seconds| duration(Duration::from_secs(seconds)));
        assert_eq!(texts, ["5 s", "1 min 5 s", "1 h 1 min", "1 d 1 h"]);
    }

    #[test]
    fn rough_times_have_one() {
        let texts = [3.2, 99.0, 100.0, 3_600.0, 9_000.0].map(rough_duration);
        assert_eq!(texts, ["3 s", "99 s", "2 min", "60 min", "2.5 h"]);
    }

    #[test]
    fn sizes_have_one_decimal() {
        assert_eq!(gib(3 << 29), "1.5 GiB");
    }
}
