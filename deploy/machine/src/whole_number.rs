//! Whole numbers as people write them: `1000000`, `1_000_000`, `1e6`, `2.5e5`.
//! Non-integers are rejected, not rounded.

use std::ops::RangeInclusive;

/// Reads a whole number below 2^64. An error says what to write.
pub fn read(text: &str) -> Result<u64, String> {
    if text.starts_with('-') {
        return Err(format!("{text} is negative"));
    }
    let none = || format!("{text:?} is not a whole number; write one as 1000000, 1_000_000 or 1e6");
    let plain = text.replace('_', "");
    let (mantissa, exponent) = plain.split_once(['e', 'E']).unwrap_or((&plain, "0"));
    let (whole, fraction) = mantissa.split_once('.').unwrap_or((mantissa, ""));
    let fraction = fraction.trim_end_matches('0');
    let digits = format!("{whole}{fraction}");
    if digits.is_empty() || whole.is_empty() || !digits.bytes().all(|it| it.is_ascii_digit()) {
        return Err(none());
    }
    let exponent: usize = exponent.parse().map_err(|_| none())?;
    let zeros = exponent.checked_sub(fraction.len()).ok_or_else(none)?;
    // No 64-bit number has more than 20 digits.
    let zeros = match digits.bytes().all(|it| it == b'0') {
        true => 0,
        false => zeros.min(20),
    };
    let number = (digits + &"0".repeat(zeros)).parse();
    number.map_err(|_| format!("{text} is more than {}", u64::MAX))
}

/// Returns a parser for a flag whose value is a whole number in `range`.
pub fn within(
    range: RangeInclusive<u64>,
) -> impl Fn(&str) -> Result<u64, String> + Clone + Send + Sync + 'static {
    move |text| {
        let number = read(text)?;
        let (least, most) = (range.start(), range.end());
        match range.contains(&number) {
            true => Ok(number),
            // The largest number of 64 bits helps no user.
            false if number < *least && *most >= i64::MAX as u64 => {
                Err(format!("{number} is too few: give {least} or more"))
            }
            false => Err(format!("{number} is not in {least}..={most}")),
        }
    }
}

/// [`within`] for a flag of 32 bits.
pub fn within_u32(
    range: RangeInclusive<u32>,
) -> impl Fn(&str) -> Result<u32, String> + Clone + Send + Sync + 'static {
    let read = within(u64::from(*range.start())..=u64::from(*range.end()));
    move |text| Ok(read(text)? as u32)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_are_read_as_they_are_written() {
        for (text, number) in [
            ("0", 0),
            ("1000000", 1_000_000),
            ("1_000_000", 1_000_000),
            ("1e6", 1_000_000),
            ("1E6", 1_000_000),
            ("2.5e5", 250_000),
            ("1.0", 1),
            ("1.50e1", 15),
            ("0e99", 0),
            ("18446744073709551615", u64::MAX),
        ] {
            assert_eq!(read(text), Ok(number), "{text}");
        }
    }

    #[test]
    fn what_is_not_whole_is_refused() {
        for text in [
            "", "ten", "1.5", "1e-1", "1.25e1", "e6", ".5e1", "1e", "1e6x", "+", "_", "1e1e1",
            "0x10",
        ] {
            let said = read(text).unwrap_err();
            let is_told = said.contains("is not a whole number; write one as");
            assert!(is_told, "{text}: {said}");
        }
        for text in ["18446744073709551616", "1e20", "1e99999999"] {
            assert!(read(text).unwrap_err().contains("is more than"), "{text}");
        }
        assert_eq!(read("-1").unwrap_err(), "-1 is negative");
        let few = within(1..=10);
        assert_eq!(few("1e1"), Ok(10));
        assert_eq!(few("11").unwrap_err(), "11 is not in 1..=10");
        let seed = within(0..=i64::MAX as u64);
        assert!(seed("1e19").unwrap_err().contains("is not in 0..="));
    }
}
