//! Measures how long another process has not answered. Time in which this process was stopped hardly counts.
//! The caller sends requests and decides when to give up.

use std::time::{Duration, Instant};

/// The longest time between two failed attempts that counts, besides one attempt's time-out: a running process retries sooner.
const GAP_MAX: Duration = Duration::from_secs(15);

/// The time for which another process has not answered.
///
/// While this process is stopped (Ctrl-Z, a paused container), at most 15 s and one attempt's time-out count, or the limit that was given:
/// it could not ask, and the other process may have been stopped too.
#[derive(Clone, Copy, Debug)]
pub struct Silence {
    length: Duration,
    last_attempt: Instant,
    gap_max: Duration,
}

/// A silence that begins now, for attempts with a time-out of at most 10 s.
impl Default for Silence {
    fn default() -> Self {
        Self::with_try_timeout(Duration::ZERO)
    }
}

impl Silence {
    /// A silence that begins now, for attempts with a time-out of at most `try_timeout`.
    pub fn with_try_timeout(try_timeout: Duration) -> Self {
        Self::with_gap_max(GAP_MAX + try_timeout)
    }

    /// A silence that begins now. Of the time between two attempts, at most `gap_max` counts.
    pub fn with_gap_max(gap_max: Duration) -> Self {
        Self {
            length: Duration::ZERO,
            last_attempt: Instant::now(),
            gap_max,
        }
    }

    /// Changes the time-out of the attempts.
    pub fn set_try_timeout(&mut self, try_timeout: Duration) {
        self.gap_max = GAP_MAX + try_timeout;
    }

    /// Records an answer: the silence begins again.
    pub fn record_answer(&mut self) {
        (self.length, self.last_attempt) = (Duration::ZERO, Instant::now());
    }

    /// Records that an attempt just failed; returns the length of the silence.
    pub fn record_failure(&mut self) -> Duration {
        self.failure_at(Instant::now())
    }

    fn failure_at(&mut self, now: Instant) -> Duration {
        self.length += (now - self.last_attempt).min(self.gap_max);
        self.last_attempt = now;
        self.length
    }

    /// The length of the silence at the last attempt.
    pub const fn length(&self) -> Duration {
        self.length
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn of_the_time_in_which_this_process_was_stopped_little_counts() {
        let (default, seconds) = (Silence::default(), Duration::from_secs);
        for (mut silence, lengths) in [
            (default, [10, 20, 35, 46]),
            (Silence::with_try_timeout(seconds(120)), [10, 20, 155, 166]),
            (Silence::with_gap_max(seconds(2)), [2, 4, 6, 8]),
        ] {
            let begin = silence.last_attempt;
            for (now, length) in [10, 20, 500, 511].into_iter().zip(lengths) {
                let now = begin + Duration::from_secs(now);
                assert_eq!(silence.failure_at(now).as_secs(), length, "at {now:?}");
            }
            silence.record_answer();
            assert_eq!(silence.length(), Duration::ZERO);
        }
    }
}
