//! How fast a run is, over the last while.
//! It asks no process.

use std::{
    collections::VecDeque,
    time::{Duration, Instant},
};

/// Frames and updates a second.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct Speed {
    pub(crate) frames: f64,
    pub(crate) updates: f64,
}

const RATE_WINDOW: Duration = Duration::from_secs(20);

/// When counts were taken, and how many frames and updates they were.
type Sample = (Instant, u64, u64);

#[derive(Clone, Debug, Default)]
pub(crate) struct Rates(VecDeque<Sample>);

impl Rates {
    pub(crate) fn add(&mut self, now: Instant, frames: u64, updates: u64) {
        self.0.push_back((now, frames, updates));
        while self.0.len() > 2 && now - self.0[1].0 >= RATE_WINDOW {
            self.0.pop_front();
        }
    }

    /// Each since the last time at which nothing of it had happened yet; 0 before the second sample.
    pub(crate) fn speed(&self) -> Speed {
        let rate = |count: fn(&Sample) -> u64| {
            let (first, last) = (self.0.front()?, self.0.back()?);
            let mut newest_first = self.0.iter().rev();
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

    fn rates(samples: impl IntoIterator<Item = (u64, u64, u64)>) -> Rates {
        let (mut rates, start) = (Rates::default(), Instant::now());
        for (second, frames, updates) in samples {
            rates.add(start + Duration::from_secs(second), frames, updates);
        }
        rates
    }

    #[test]
    fn rates_forget_what_is_long_ago_and_a_warm_up_does_not_dilute_them() {
        assert_eq!(rates([]).speed(), Speed::default());
        let frames_after_50_s = |second: u64| (second, second.saturating_sub(50) * 10, 0);
        let long = rates((0..100).map(frames_after_50_s));
        assert_eq!(long.speed().frames, 10.0);
        assert!(long.0.len() <= 22);
        let warmed_up = rates([(0, 0, 7), (10, 10, 7), (12, 12, 47)]).speed();
        assert_eq!((warmed_up.frames, warmed_up.updates), (1.0, 20.0));
    }
}
