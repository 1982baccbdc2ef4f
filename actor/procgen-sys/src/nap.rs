//! How long the calling thread sleeps before it waits for the engine's threads.
//! It knows nothing of the engine: the caller reports how long steps took.
//!
//! The engine's `observe` waits for the first environment, then for the second, but wakes whenever *any* environment is done. With 32
//! environments the calling thread wakes about 20 times a step, each time at the cost of an engine thread's processor time. A thread
//! that sleeps through the first half of a step avoids the wake-ups in that half.

use std::time::Duration;

/// The shortest nap; shorter ones are skipped, as a sleep may end some 60 us late.
const NAP_MIN: Duration = Duration::from_micros(100);

/// The longest nap, for the case that the process was stopped during the first step.
const NAP_MAX: Duration = Duration::from_millis(100);

/// A sleep of half the duration of a fast step, estimated from the latest steps.
#[derive(Debug, Default)]
pub(crate) struct Nap {
    /// The estimated duration of a fast step; `None` before the first step.
    estimate: Option<Duration>,
}

impl Nap {
    /// Sleeps for the nap, if there is one; a step that has just begun takes longer than it.
    pub(crate) fn sleep(&self) {
        if let Some(duration) = self.duration() {
            std::thread::sleep(duration);
        }
    }

    /// Updates the estimate by the duration of a step, including the nap. A step that makes levels takes longer, so one
    /// step raises the estimate by at most an eighth.
    pub(crate) fn update(&mut self, took: Duration) {
        let estimate = self.estimate.map_or(took, |it| took.min(it + it / 8));
        self.estimate = Some(estimate);
    }

    fn duration(&self) -> Option<Duration> {
        let nap = self.estimate.map(|it| NAP_MAX.min(it / 2));
        nap.filter(|nap| *nap >= NAP_MIN)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const fn us(us: u64) -> Duration {
        Duration::from_micros(us)
    }

    #[test]
    fn a_nap_is_half_a_fast_step_and_left_out_where_steps_are_short() {
        for (steps, duration) in [
            (&[][..], None),
            (&[400], Some(us(200))),
            (&[400, 4_000], Some(us(225))),
            (&[400, 4_000, 400], Some(us(200))),
            (&[3_600_000_000], Some(us(100_000))),
            (&[199], None),
            (&[400, 150], None),
        ] {
            let mut nap = Nap::default();
            steps.iter().for_each(|&step| nap.update(us(step)));
            assert_eq!(nap.duration(), duration, "{steps:?}");
        }
    }

    #[test]
    fn a_nap_that_was_too_long_is_halved_until_it_is_not() {
        let mut nap = Nap::default();
        nap.update(us(64_000));
        let mut steps = 0;
        while let Some(slept) = nap.duration()
            && slept > us(300)
        {
            nap.update(slept.max(us(600)));
            steps += 1;
        }
        assert_eq!((nap.duration(), steps), (Some(us(300)), 7));
    }
}
