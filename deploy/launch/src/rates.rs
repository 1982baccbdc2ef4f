//! How fast a run is: frames and updates a second.

use std::{
    collections::VecDeque,
    time::{Duration, Instant},
};

use crate::moment::Speed;

/// The time over which rates are means.
const RATE_WINDOW: Duration = Duration::from_secs(20);

/// The counts of the last while, and so the speed.
#[derive(Clone, Debug, Default)]
pub(crate) struct Rates {
    samples: VecDeque<(Instant, u64, u64)>,
}

impl Rates {
    /// Takes the counts at `now`.
    pub(crate) fn add(&mut self, now: Instant, frames: u64, updates: u64) {
        self.samples.push_back((now, frames, updates));
        while self.samples.len() > 2 && now - self.samples[1].0 >= RATE_WINDOW {
            self.samples.pop_front();
        }
    }

    /// Each since the last time at which nothing of it had happened yet; 0 before the second sample.
    pub(crate) fn speed(&self) -> Speed {
        let rate = |count: fn(&(Instant, u64, u64)) -> u64| {
            let (first, last) = (self.samples.front()?, self.samples.back()?);
            let mut newest_first = self.samples.iter().rev();
            let idle = newest_first.find(|it| count(it) == count(first))?;
            let seconds = (last.0 - idle.0).as_secs_f64();
            (seconds > 0.0).then(|| count(last).saturating_sub(count(idle)) as f64 / seconds)
        };
        Speed {
            frames: rate(|it| it.1).unwrap_or(0.0),
            updates: rate(|it| it.2).unwrap_or(0.0),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rates_forget_what_is_long_ago() {
        let (mut rates, start) = (Rates::default(), Instant::now());
        assert_eq!(rates.speed(), Speed::default());
        for second in 0..100 {
            let frames = if second < 50 { 0 } else { (second - 50) * 10 };
            rates.add(start + Duration::from_secs(second), frames, 0);
        }
        assert_eq!(rates.speed().frames, 10.0);
        assert!(rates.samples.len() <= 22);
    }

    #[test]
    fn a_warm_up_does_not_dilute_the_rate() {
        let (mut rates, start) = (Rates::default(), Instant::now());
        for (second, updates) in [(0, 7), (10, 7), (12, 47)] {
            rates.add(start + Duration::from_secs(second), second, updates);
        }
        let expected = Speed {
            frames: 1.0,
            updates: 20.0,
        };
        assert_eq!(rates.speed(), expected);
    }
}
