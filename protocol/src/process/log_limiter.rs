//! Limits log lines that could come many times a second: the first of a kind at once, then at most one in each period, with a count.
//! The caller writes the lines.

use std::time::{Duration, Instant};

/// The shortest time between two written lines of a kind, unless the caller names another.
const PERIOD: Duration = Duration::from_secs(10);

/// Decides which lines of one kind are written.
#[derive(Debug, Default)]
pub struct LogLimiter {
    last_written: Option<Instant>,
    suppressed: u64,
}

impl LogLimiter {
    /// Returns how many lines were left out since the last one, and counts them no longer.
    pub const fn take_suppressed(&mut self) -> u64 {
        std::mem::replace(&mut self.suppressed, 0)
    }

    /// Returns `None` if a line must not be written now, else the text to append: how many like it were left out since the last, if any.
    pub fn admit(&mut self) -> Option<String> {
        self.admit_within(PERIOD)
    }

    /// [`Self::admit`] for at most one line in each `period`.
    pub fn admit_within(&mut self, period: Duration) -> Option<String> {
        self.admit_at(Instant::now(), period)
    }

    fn admit_at(&mut self, now: Instant, period: Duration) -> Option<String> {
        let is_fresh = |written| now.saturating_duration_since(written) < period;
        if self.last_written.is_some_and(is_fresh) {
            self.suppressed += 1;
            return None;
        }
        self.last_written = Some(now);
        Some(match self.take_suppressed() {
            0 => String::new(),
            n => format!(" (and {n} more like this since the last such line)"),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_first_line_comes_at_once_and_the_others_are_counted() {
        let (mut limiter, start) = (LogLimiter::default(), Instant::now());
        assert_eq!(limiter.admit_at(start, PERIOD).as_deref(), Some(""));
        for _ in 0..3 {
            assert_eq!(limiter.admit_at(start + PERIOD / 2, PERIOD), None);
        }
        let more = limiter.admit_at(start + PERIOD, PERIOD);
        assert_eq!(
            more.as_deref(),
            Some(" (and 3 more like this since the last such line)")
        );
        assert_eq!(
            limiter.admit_at(start + 2 * PERIOD, PERIOD).as_deref(),
            Some("")
        );
    }
}
