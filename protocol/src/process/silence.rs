//! For how long another process has not answered, by a clock that stands while this process is stopped.
//! It sends nothing and gives up nothing.

use std::time::{Duration, Instant};

/// A process that runs asks again more often than this: what passes beyond it between two looks, it was stopped.
const LOOK_MAX: Duration = Duration::from_secs(30);

/// For how long another process has not answered. What this one spends stopped (Ctrl-Z, a paused container) does not count: it could
/// not hear the other, which may have been stopped with it.
#[derive(Clone, Copy, Debug)]
pub struct Silence {
    passed: Duration,
    looked: Instant,
}

impl Silence {
    /// A silence that begins now.
    pub fn begin() -> Self {
        Self {
            passed: Duration::ZERO,
            looked: Instant::now(),
        }
    }

    /// The other answered: the silence begins again.
    pub fn heard(&mut self) {
        *self = Self::begin();
    }

    /// The other did not answer, when asked just now; gives the length of its silence.
    pub fn unheard(&mut self) -> Duration {
        self.unheard_at(Instant::now())
    }

    fn unheard_at(&mut self, now: Instant) -> Duration {
        self.passed += (now - self.looked).min(LOOK_MAX);
        self.looked = now;
        self.passed
    }

    /// The length of the silence when the other was asked last.
    pub const fn passed(&self) -> Duration {
        self.passed
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_time_in_which_this_process_was_stopped_does_not_count() {
        let mut silence = Silence::begin();
        let begin = silence.looked;
        let at = |seconds| begin + Duration::from_secs(seconds);
        for (now, passed) in [(10, 10), (20, 20), (500, 50), (511, 61)] {
            assert_eq!(silence.unheard_at(at(now)).as_secs(), passed, "at {now} s");
        }
        assert_eq!(silence.passed().as_secs(), 61);
        silence.heard();
        assert_eq!(silence.passed(), Duration::ZERO);
    }
}
