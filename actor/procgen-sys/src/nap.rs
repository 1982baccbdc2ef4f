//! How long the calling thread leaves the engine's threads alone before it waits for them.
//! It knows nothing of the engine: it is told how long steps took.
//!
//! The engine's `observe` waits for the first environment, then for the second, and is woken whenever *any* of them is done: with 32 environments
//! the calling thread wakes about 20 times a step, and each time an engine's thread has to make room for it. A thread that
//! sleeps through the first half of a step is not there to be woken.

use std::time::Duration;

/// Shorter ones are left out: a sleep may end some 60 us late.
const NAP_MIN: Duration = Duration::from_micros(100);

/// Half of what a fast step takes, by the latest ones.
#[derive(Debug, Default)]
pub(crate) struct Nap {
    /// What a fast step takes; `None` before the first.
    step: Option<Duration>,
}

impl Nap {
    /// Sleeps for as long as a step that has just begun surely takes.
    pub(crate) fn take(&self) {
        if let Some(duration) = self.duration() {
            std::thread::sleep(duration);
        }
    }

    /// Learns how long a step took, the nap included. One that makes levels takes longer than others, so a step counts as at most an
    /// eighth longer than those before.
    pub(crate) fn learn(&mut self, took: Duration) {
        let step = self.step.map_or(took, |step| took.min(step + step / 8));
        self.step = Some(step);
    }

    fn duration(&self) -> Option<Duration> {
        self.step.map(|step| step / 2).filter(|nap| *nap >= NAP_MIN)
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
            (&[199], None),
            (&[400, 150], None),
        ] {
            let mut nap = Nap::default();
            steps.iter().for_each(|&step| nap.learn(us(step)));
            assert_eq!(nap.duration(), duration, "{steps:?}");
        }
    }

    #[test]
    fn a_nap_that_was_too_long_is_halved_until_it_is_not() {
        let mut nap = Nap::default();
        nap.learn(us(64_000));
        let mut steps = 0;
        while let Some(slept) = nap.duration()
            && slept > us(300)
        {
            nap.learn(slept.max(us(600)));
            steps += 1;
        }
        assert_eq!((nap.duration(), steps), (Some(us(300)), 7));
    }
}
