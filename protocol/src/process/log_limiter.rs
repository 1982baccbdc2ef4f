//! Limits log lines that could come many times a second: the first of a kind at once, then at most one every 10 s with a count.
//! The caller writes the lines.

use std::time::{Duration, Instant};

/// The shortest time between two written lines of a kind.
const PERIOD: Duration = Duration::from_secs(10);

/// Decides which lines of one kind are written.
#[derive(Debug, Default)]
pub struct LogLimiter {
    written: Option<Instant>,
    left_out: u64,
}

impl LogLimiter {
    /// Returns `None` if a line must not be written now, else the text to append: how many like it were left out since the last, if any.
    pub fn due(&mut self) -> Option<String> {
        self.due_at(Instant::now())
    }

    fn due_at(&mut self, now: Instant) -> Option<String> {
        let is_fresh = |written| now.saturating_duration_since(written) < PERIOD;
        if self.written.is_some_and(is_fresh) {
            self.left_out += 1;
            return None;
        }
        self.written = Some(now);
        Some(match std::mem::take(&mut self.left_out) {
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
        assert_eq!(limiter.due_at(start).as_deref(), Some(""));
        for _ in 0..3 {
            assert_eq!(limiter.due_at(start + PERIOD / 2), None);
        }
        let more = limiter.due_at(start + PERIOD);
        assert_eq!(
            more.as_deref(),
            Some(" (and 3 more like this since the last such line)")
        );
        assert_eq!(limiter.due_at(start + 2 * PERIOD).as_deref(), Some(""));
    }
}
