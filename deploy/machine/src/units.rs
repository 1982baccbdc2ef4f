//! Times, sizes and other numbers in human-readable form.

use std::{fmt::Display, time::Duration};

/// Formats a time in at most two units, such as `17 min 23 s`.
pub fn duration(time: Duration) -> String {
    let seconds = time.as_secs();
    match seconds {
        0..60 => format!("{seconds} s"),
        60..3600 => format!("{} min {} s", seconds / 60, seconds % 60),
        3600..86_400 => format!("{} h {} min", seconds / 3600, seconds % 3600 / 60),
        _ => format!("{} d {} h", seconds / 86_400, seconds % 86_400 / 3600),
    }
}

/// Formats a rough time in one unit, such as `25 min`.
pub fn rough_duration(seconds: f64) -> String {
    if seconds < 99.5 {
        format!("{seconds:.0} s")
    } else if seconds < 5_970.0 {
        format!("{:.0} min", seconds / 60.0)
    } else {
        format!("{:.1} h", seconds / 3_600.0)
    }
}

/// Formats a count and its noun, which gets an s unless the count is 1: `1 frame`, `2 frames`.
pub fn count<N: Display + PartialEq + From<u8>>(number: N, noun: &str) -> String {
    let ending = if number == N::from(1) { "" } else { "s" };
    format!("{number} {noun}{ending}")
}

/// Formats a size in GiB, with one decimal.
pub fn gib(bytes: u64) -> String {
    format!("{:.1} GiB", bytes as f64 / f64::from(1 << 30))
}

/// Reads the number of KiB after `name` in one of the kernel's tables, such as `/proc/meminfo`.
pub fn proc_kib(table: &str, name: &str) -> Option<u64> {
    let line = table.lines().find_map(|line| line.strip_prefix(name))?;
    line.trim().strip_suffix("kB")?.trim().parse().ok()
}

/// Formats a number with three significant digits, but with all digits before the point and at most three decimals.
pub fn format_number(value: f64) -> String {
    match value.abs() {
        size if size >= 99.95 => format!("{value:.0}"),
        size if size >= 9.995 => format!("{value:.1}"),
        size if size >= 0.9995 || size == 0.0 => format!("{value:.2}"),
        _ => format!("{value:.3}"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn times_sizes_and_numbers_have_the_digits_that_matter() {
        let texts = [5, 65, 3_660, 90_000].map(|seconds| duration(Duration::from_secs(seconds)));
        assert_eq!(texts, ["5 s", "1 min 5 s", "1 h 1 min", "1 d 1 h"]);
        let texts = [3.2, 99.0, 100.0, 3_600.0, 9_000.0].map(rough_duration);
        assert_eq!(texts, ["3 s", "99 s", "2 min", "60 min", "2.5 h"]);
        let texts = [0.0, 0.12345, 1.2345, 12.345, 123.45, 61_234.5].map(format_number);
        assert_eq!(texts, ["0.00", "0.123", "1.23", "12.3", "123", "61234"]);
        let texts = [0.9994, 0.9996, 9.994, 9.996, 99.94, 99.96].map(format_number);
        assert_eq!(texts, ["0.999", "1.00", "9.99", "10.0", "99.9", "100"]);
        assert_eq!(gib(3 << 29), "1.5 GiB");
        let texts = [0, 1, 2].map(|number: u64| count(number, "frame"));
        assert_eq!(texts, ["0 frames", "1 frame", "2 frames"]);
    }

    #[test]
    fn memory_is_read_from_the_kernel_s_tables() {
        let table = "MemFree:        1000 kB\nVmLck:\t    2048 kB\n";
        assert_eq!(proc_kib(table, "VmLck:"), Some(2048));
        assert_eq!(proc_kib(table, "VmRSS:"), None);
    }
}
