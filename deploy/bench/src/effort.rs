//! How long something is measured, and how its speed is taken.
//! It keeps no figure and judges none.

use std::time::{Duration, Instant};

use crate::flags::BenchFlags;

/// How long each thing is measured.
#[derive(Clone, Copy, Debug)]
pub(super) struct Effort {
    /// Calls before the first that counts.
    warmup_calls: u32,
    /// Calls that count, at least.
    calls_min: usize,
    /// Time of the calls that count, at least.
    time_min: Duration,
}

impl Effort {
    /// What the flags ask for.
    pub(super) fn new(flags: &BenchFlags) -> Self {
        let (warmup_calls, calls_min, time_min) = match flags.quick {
            true => (1, 2, Duration::from_millis(200)),
            false => (2, 3, Duration::from_secs(4)),
        };
        Self {
            warmup_calls,
            calls_min,
            time_min,
        }
    }

    /// Calls of `work` a second, by the median of their durations: for calls that all do the same.
    ///
    /// # Errors
    /// The first of `work`'s.
    pub(super) fn rate_by_median<E>(
        &self,
        mut work: impl FnMut() -> Result<(), E>,
    ) -> Result<f64, E> {
        Ok(1.0 / median(&self.durations(&mut work)?))
    }

    /// Calls of `work` a second over all of them: for calls of which a few do much more than the others.
    ///
    /// # Errors
    /// The first of `work`'s.
    pub(super) fn rate_overall<E>(
        &self,
        mut work: impl FnMut() -> Result<(), E>,
    ) -> Result<f64, E> {
        let durations = self.durations(&mut work)?;
        Ok(durations.len() as f64 / durations.iter().sum::<f64>())
    }

    /// Seconds of each call.
    fn durations<E>(&self, work: &mut impl FnMut() -> Result<(), E>) -> Result<Vec<f64>, E> {
        for _ in 0..self.warmup_calls {
            work()?;
        }
        let (first, mut durations) = (Instant::now(), Vec::new());
        while durations.len() < self.calls_min || first.elapsed() < self.time_min {
            let started = Instant::now();
            work()?;
            durations.push(started.elapsed().as_secs_f64());
        }
        Ok(durations)
    }

    /// Calls a second of each of `works`, by the median. They take turns, so that a load of the machine meets them alike; each is told
    /// how many calls it had.
    ///
    /// # Errors
    /// The first of a call's.
    pub(super) fn rates_in_turn<E>(
        &self,
        works: &mut [&mut dyn FnMut(usize) -> Result<(), E>],
    ) -> Result<Vec<f64>, E> {
        let mut seconds = vec![Vec::new(); works.len()];
        let (first, mut calls, warmup) = (Instant::now(), 0, self.warmup_calls as usize);
        while calls < warmup + self.calls_min || first.elapsed() < self.time_min {
            for (work, seconds) in works.iter_mut().zip(&mut seconds) {
                let started = Instant::now();
                work(calls)?;
                seconds.push(started.elapsed().as_secs_f64());
            }
            calls += 1;
        }
        let rate = |seconds: &Vec<f64>| 1.0 / median(&seconds[warmup..]);
        Ok(seconds.iter().map(rate).collect())
    }

    /// Whether something that began at `started` has been measured for long enough.
    pub(super) fn is_spent(&self, started: Instant) -> bool {
        started.elapsed() >= self.time_min
    }
}

/// The middle value, or the mean of the two in the middle; NaN of none.
pub(super) fn median(values: &[f64]) -> f64 {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    match (sorted.len() / 2, sorted.len() % 2) {
        (0, 0) => f64::NAN,
        (half, 0) => (sorted[half - 1] + sorted[half]) / 2.0,
        (half, _) => sorted[half],
    }
}

#[cfg(test)]
mod tests {
    use std::convert::Infallible;

    use super::*;

    #[test]
    fn a_median_is_in_the_middle() {
        assert_eq!(median(&[3.0, 1.0, 2.0]), 2.0);
        assert_eq!(median(&[4.0, 1.0, 2.0, 3.0]), 2.5);
        assert_eq!(median(&[7.0]), 7.0);
        assert!(median(&[]).is_nan());
    }

    #[test]
    fn calls_are_counted_after_the_warm_up() {
        let effort = Effort {
            warmup_calls: 2,
            calls_min: 3,
            time_min: Duration::ZERO,
        };
        let mut calls = 0;
        let mut work = || {
            calls += 1;
            Ok::<_, Infallible>(())
        };
        let Ok(durations) = effort.durations(&mut work);
        assert_eq!((durations.len(), calls), (3, 5));
        assert_eq!(effort.rate_by_median(|| Err("broken")), Err("broken"));
    }
}
