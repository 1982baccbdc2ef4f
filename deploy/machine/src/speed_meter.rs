//! The one measuring loop: how long a benchmark runs, and how its speed is computed.
//! This module keeps no figures and judges none.

use std::{
    hint::black_box,
    time::{Duration, Instant},
};

/// The function that is measured; each call is timed.
pub type Work<'a> = Box<dyn FnMut() -> anyhow::Result<()> + 'a>;

/// How long each piece of work is measured.
#[derive(Clone, Copy, Debug)]
pub struct SpeedMeter {
    /// Warm-up calls, which are not timed.
    warmup_calls: u32,
    calls_min: usize,
    time_min: Duration,
}

impl SpeedMeter {
    /// At least 4 s of timed calls, or 0.2 s if `quick`.
    pub const fn new(quick: bool) -> Self {
        let (warmup_calls, calls_min, time_min) = match quick {
            true => (1, 2, Duration::from_millis(200)),
            false => (2, 3, Duration::from_secs(4)),
        };
        Self {
            warmup_calls,
            calls_min,
            time_min,
        }
    }

    /// Calls of `work` per second, from the median duration: for calls that all do the same.
    pub fn rate_by_median<'a, T>(
        &self,
        mut work: impl FnMut() -> anyhow::Result<T> + 'a,
    ) -> anyhow::Result<f64> {
        let work = move || work().map(|it| drop(black_box(it)));
        Ok(self.rates_in_turn(&mut [Box::new(work)])?[0])
    }

    /// Calls of `work` per second over all calls: for work in which a few calls do much more than the others.
    pub fn rate_overall<'a>(
        &self,
        work: impl FnMut() -> anyhow::Result<()> + 'a,
    ) -> anyhow::Result<f64> {
        let durations = &self.durations(&mut [Box::new(work)])?[0];
        Ok(durations.len() as f64 / durations.iter().sum::<f64>())
    }

    /// Calls per second of each of `works`, from the median duration. The works take turns, so that load affects them alike.
    pub fn rates_in_turn(&self, works: &mut [Work<'_>]) -> anyhow::Result<Vec<f64>> {
        let durations = self.durations(works)?;
        Ok(durations.iter().map(|it| 1.0 / median(it)).collect())
    }

    /// The duration in seconds of each timed call of each work. The works take turns, after the warm-up.
    fn durations(&self, works: &mut [Work<'_>]) -> anyhow::Result<Vec<Vec<f64>>> {
        for _ in 0..self.warmup_calls {
            works.iter_mut().try_for_each(|work| work())?;
        }
        let (first, mut calls, mut seconds) = (Instant::now(), 0, vec![Vec::new(); works.len()]);
        while calls < self.calls_min || !self.is_long_enough(first) {
            for (work, seconds) in works.iter_mut().zip(&mut seconds) {
                let started = Instant::now();
                work()?;
                seconds.push(started.elapsed().as_secs_f64());
            }
            calls += 1;
        }
        Ok(seconds)
    }

    /// Whether a measurement that began at `started` has lasted long enough.
    pub fn is_long_enough(&self, started: Instant) -> bool {
        started.elapsed() >= self.time_min
    }
}

/// The middle value, or the mean of the two middle values; NaN for no values.
pub fn median(values: &[f64]) -> f64 {
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
    use std::cell::RefCell;

    use super::*;

    #[test]
    fn works_take_turns_and_calls_are_counted_after_the_warm_up() {
        let meter = SpeedMeter {
            warmup_calls: 2,
            calls_min: 3,
            time_min: Duration::ZERO,
        };
        let calls = RefCell::new(String::new());
        let work = |name: char| -> Work<'_> {
            let calls = &calls;
            Box::new(move || {
                calls.borrow_mut().push(name);
                Ok(())
            })
        };
        let durations = meter.durations(&mut [work('a'), work('b')]).unwrap();
        let counts: Vec<_> = durations.iter().map(Vec::len).collect();
        assert_eq!(counts, [3, 3]);
        assert_eq!(*calls.borrow(), "ababababab");
        let broken = || -> anyhow::Result<()> { anyhow::bail!("broken") };
        assert!(meter.rate_by_median(broken).is_err());
    }
}
