//! How fast a run is: frames and updates a second.

use std::{
    collections::VecDeque,
    time::{Duration, Instant},
};

/// The time over which rates are means.
const RATE_WINDOW: Duration = Duration::from_secs(20);

/// Frames and updates a second, over the last while.
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

    /// Frames a second and updates a second; 0 before the second sample.
    pub(crate) fn per_second(&self) -> (f64, f64) {
        let (Some(first), Some(last)) = (self.samples.front(), self.samples.back()) else {
            return (0.0, 0.0);
        };
        let seconds = (last.0 - first.0).as_secs_f64();
        if seconds <= 0.0 {
            return (0.0, 0.0);
        }
        (
            last.1.saturating_sub(first.1) as f64 / seconds,
            last.2.saturating_sub(first.2) as f64 / seconds,
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rates_forget_what_is_long_ago() {
        let (mut rates, start) = (Rates::default(), Instant::now());
        assert_eq!(rates.per_second(), (0.0, 0.0));
        for second in 0..100 {
            rates.add(
                start + Duration::from_secs(second),
                if second < 50 { 0 } else { (second - 50) * 10 },
                0,
            );
        }
        assert_eq!(rates.per_second().0, 10.0);
        assert!(rates.samples.len() <= 22);
    }
}
