//! Measures how long another process has not answered. Time in which this process was stopped hardly counts.
//! The caller sends requests and decides when to give up.

use std::time::{Duration, Instant};

/// The longest time between two failed attempts that counts, besides one attempt's time-out: a running process retries sooner.
const LOOK_MAX: Duration = Duration::from_secs(15);

/// The time for which another process has not answered.
///
/// While this process is stopped (Ctrl-Z, a paused container), at most 15 s and one attempt's time-out count: it could not ask, and the
/// other process may have been stopped too.
#[derive(Clone, Copy, Debug)]
pub struct Silence {
    length: Duration,
    looked: Instant,
    look_max: Duration,
}

/// A silence that begins now, for attempts with a time-out of at most 10 s.
impl Default for Silence {
    fn default() -> Self {
        Self::with_tries_of(Duration::ZERO)
    }
}

impl Silence {
    /// A silence that begins now, for attempts with a time-out of at most `try_max`.
    pub fn with_tries_of(try_max: Duration) -> Self {
        Self {
            length: Duration::ZERO,
            looked: Instant::now(),
            look_max: LOOK_MAX + try_max,
        }
    }

    /// Records an answer: the silence begins again.
    pub fn answered(&mut self) {
        (self.length, self.looked) = (Duration::ZERO, Instant::now());
    }

    /// Records that an attempt just failed; returns the length of the silence.
    pub fn unanswered(&mut self) -> Duration {
        self.unanswered_at(Instant::now())
    }

    fn unanswered_at(&mut self, now: Instant) -> Duration {
        self.length += (now - self.looked).min(self.look_max);
        self.looked = now;
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
        for (try_s, lengths) in [(0, [10, 20, 35, 46]), (120, [10, 20, 155, 166])] {
            let mut silence = Silence::with_tries_of(Duration::from_secs(try_s));
            let begin = silence.looked;
            for (now, length) in [10, 20, 500, 511].into_iter().zip(lengths) {
                let now = begin + Duration::from_secs(now);
                assert_eq!(silence.unanswered_at(now).as_secs(), length, "at {now:?}");
            }
            silence.answered();
            assert_eq!(silence.length(), Duration::ZERO);
        }
    }
}
