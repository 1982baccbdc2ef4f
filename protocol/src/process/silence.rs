//! For how long another process has not answered. Of a time in which this process was stopped only a little counts.
//! It sends nothing and gives up nothing.

use std::time::{Duration, Instant};

/// The longest time between two looks that counts, beside what one try waits: a process that runs asks again sooner.
const LOOK_MAX: Duration = Duration::from_secs(15);

/// For how long another process has not answered.
///
/// Of what this process spends stopped (Ctrl-Z, a paused container) at most 15 s count: it could not ask, and the other may have been
/// stopped with it.
#[derive(Clone, Copy, Debug)]
pub struct Silence {
    length: Duration,
    looked: Instant,
    look_max: Duration,
}

/// A silence that begins now; a try waits for its answer for no more than 10 s.
impl Default for Silence {
    fn default() -> Self {
        Self::with_tries_of(Duration::ZERO)
    }
}

impl Silence {
    /// A silence that begins now; a try may wait for its answer as long as this.
    pub fn with_tries_of(try_max: Duration) -> Self {
        Self {
            length: Duration::ZERO,
            looked: Instant::now(),
            look_max: LOOK_MAX + try_max,
        }
    }

    /// The other answered: the silence begins again.
    pub fn answered(&mut self) {
        (self.length, self.looked) = (Duration::ZERO, Instant::now());
    }

    /// The other did not answer, when asked just now; gives the length of its silence.
    pub fn unanswered(&mut self) -> Duration {
        self.unanswered_at(Instant::now())
    }

    fn unanswered_at(&mut self, now: Instant) -> Duration {
        self.length += (now - self.looked).min(self.look_max);
        self.looked = now;
        self.length
    }

    /// The length of the silence when the other was asked last.
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
