//! What is known of a run at one time, which every metric is taken from, and how fast it is.
//! It names no metric.

use std::{
    collections::VecDeque,
    time::{Duration, Instant},
};

use driml_protocol::{LearnerStatus, ReplayStatus};

/// What is known of a run at one time.
#[derive(Clone, Debug)]
pub struct Moment<'a> {
    /// Since the run's start, without the time between its interruption and its resumption.
    pub seconds: Option<f64>,
    /// How fast it is, over the last while.
    pub speed: Speed,
    /// The training's episodes.
    pub episodes: Episodes,
    /// The k of the rows served with a positive.
    pub k: Option<Spread>,
    /// The probability with which all actors act at random; none where they differ in it.
    pub epsilon: Option<f64>,
    /// What the replay servers count together.
    pub replay: &'a ReplayStatus,
    /// The learner's status; none while it does not answer.
    pub learner: Option<&'a LearnerStatus>,
    /// The names of the auxiliary losses.
    pub losses: Vec<&'a str>,
    /// Resident memory of each process by name, MiB; none for one that ended.
    pub rss_mib: Vec<(&'a str, Option<f64>)>,
}

impl Moment<'_> {
    /// What the last update computed; none before the first, as a 0 would look like a loss.
    pub(crate) fn learned(&self, value: fn(&LearnerStatus) -> f64) -> Option<f64> {
        self.learner.filter(|it| it.updates > 0).map(value)
    }
}

/// Frames and updates a second.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Speed {
    /// Frames a second.
    pub frames: f64,
    /// Updates a second.
    pub updates: f64,
}

/// Mean and standard deviation over the rows served.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Spread {
    /// Mean over the rows served.
    pub mean: f64,
    /// Standard deviation over the same rows.
    pub sd: f64,
}

/// The training's episodes so far, also over a resumption.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Episodes {
    /// How many ended.
    pub count: u64,
    /// Mean return of the newest; none before the first.
    pub mean_return: Option<f64>,
    /// Episodes in the mean: 100, or as many as there were.
    pub mean_return_of: usize,
}

impl Episodes {
    /// So many, of whose newest these are the returns.
    pub(crate) fn of<'a>(count: u64, newest: impl ExactSizeIterator<Item = &'a f64>) -> Self {
        let of = newest.len();
        let sum: f64 = newest.sum();
        Self {
            count,
            mean_return: (of > 0).then(|| sum / of as f64),
            mean_return_of: of,
        }
    }
}

/// The time over which rates are means.
const RATE_WINDOW: Duration = Duration::from_secs(20);

/// When counts were taken, and how many frames and updates they were.
type Sample = (Instant, u64, u64);

/// The counts of the last while.
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

/// Six decimals, without the digits that a conversion from f32 added: -0.6, not -0.5999999940395355. Small numbers keep seven digits.
pub fn rounded(value: f64) -> f64 {
    let text = match value.abs() < 1e-3 {
        true => format!("{value:.6e}"),
        false => format!("{value:.6}"),
    };
    text.parse().unwrap_or(value)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn small_and_large_numbers_keep_their_digits() {
        let three_f32 = f64::from(-0.2f32) + f64::from(-0.2f32) + f64::from(-0.2f32);
        for (value, text) in [
            (three_f32, "-0.6"),
            (f64::from(0.1f32), "0.1"),
            (12_345.0, "12345"),
            (0.0, "0"),
            (f64::from(1e-7f32), "0.0000001"),
            (4.007, "4.007"),
            (-0.0125, "-0.0125"),
            (123_456.789, "123456.789"),
            (4.2e-7, "0.00000042"),
            (-9.87654321e-4, "-0.0009876543"),
        ] {
            assert_eq!(rounded(value).to_string(), text);
        }
        assert_eq!(rounded(1.5e30), 1.5e30);
        assert!(rounded(f64::NAN).is_nan() && rounded(f64::INFINITY).is_infinite());
    }

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
