//! An inspection as tables for a terminal.
//! It counts nothing.

use super::{line::Line, play::RowShares};

/// Columns of the first table's names; longer names push their row to the right.
const WHAT_COLUMNS: usize = 26;
const NUMBER_COLUMNS: usize = 16;

/// A table with this heading: what, how much, how much if everything were on, why; and the sum, if the lines have one.
pub(super) fn table(heading: &str, lines: &[Line], summed: bool) -> String {
    let mut text = row(heading, "is", "everything", "why");
    for line in lines {
        let (is, everything) = (thousands(line.is), thousands(line.everything));
        text += &row(&line.what, &is, &everything, &line.why);
    }
    if summed {
        let sum = |of: fn(&Line) -> u64| lines.iter().map(of).sum::<u64>();
        let (is, everything) = (sum(|line| line.is), sum(|line| line.everything));
        let share = 100.0 * is as f64 / everything.max(1) as f64;
        let why = format!("{share:.0}% of everything");
        text += &row("all", &thousands(is), &thousands(everything), &why);
    }
    text
}

/// What rows hold, with an empty line after it.
pub(super) fn played(shares: &RowShares) -> String {
    let RowShares {
        frames,
        rows,
        without_bootstrap,
        without_positive,
        absent_bytes,
        shared_bytes,
        repeated_online,
        repeated_target,
        computed_online,
        computed_target,
    } = *shares;
    let heading = format!(
        "{} rows of batches, from {} frames played with the first weights",
        thousands(rows),
        thousands(frames)
    );
    let lines = [
        (
            "bootstrap from nothing: they have no s_{t+n}",
            without_bootstrap,
        ),
        ("positives that rows do not have", without_positive),
        (
            "of a batch's bytes do not travel, as rows do not have these states",
            absent_bytes,
        ),
        (
            "of a batch's bytes do not travel, as they are frames that another of its states has (run.frame_stack)",
            shared_bytes,
        ),
        (
            "of s_t and s_{t+k} are equal to another of the batch",
            repeated_online,
        ),
        (
            "of s_{t+n} are equal to another of the batch",
            repeated_target,
        ),
        (
            "of places for s_t and s_{t+k} are computed: equal states once, where it pays (learner.equal_states)",
            computed_online,
        ),
        (
            "of places for s_{t+n} are computed: equal states once, and none of rows that bootstrap from nothing",
            computed_target,
        ),
    ];
    let lines = lines.map(|(what, share)| format!("{:>6.2}%  {what}\n", 100.0 * share));
    format!("{heading}\n{}\n", lines.concat())
}

fn row(what: &str, is: &str, everything: &str, why: &str) -> String {
    let row =
        format!("{what:WHAT_COLUMNS$}{is:>NUMBER_COLUMNS$}{everything:>NUMBER_COLUMNS$}  {why}");
    row.trim_end().to_owned() + "\n"
}

/// With a comma at every third digit.
fn thousands(number: u64) -> String {
    let digits = number.to_string();
    let mut text = String::new();
    for (at, digit) in digits.chars().enumerate() {
        if at > 0 && (digits.len() - at).is_multiple_of(3) {
            text.push(',');
        }
        text.push(digit);
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_are_readable() {
        let texts = [0, 999, 1000, 1_234_567, 10_000_000_000].map(thousands);
        assert_eq!(texts, ["0", "999", "1,000", "1,234,567", "10,000,000,000"]);
    }
}
