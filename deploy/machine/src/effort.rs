//! The one measuring loop: how long something is measured, and how its speed is taken.
//! It keeps no figure and judges none.

use std::time::{Duration, Instant};

/// What is measured; a call is what is timed.
pub type Work<'a> = Box<dyn FnMut() -> anyhow::Result<()> + 'a>;

/// How long each thing is measured.
#[derive(Clone, Copy, Debug)]
pub struct Effort {
    /// Calls before the first that counts.
    warmup_calls: u32,
    /// Calls that count, at least.
    calls_min: usize,
    /// Time of the calls that count, at least.
    time_min: Duration,
}

impl Effort {
    /// Four seconds, or a fifth of one.
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

    /// Calls of `work` a second, by the median of their durations: for calls that all do the same.
    pub fn rate_by_median<'a>(
        &self,
        work: impl FnMut() -> anyhow::Result<()> + 'a,
    ) -> anyhow::Result<f64> {
        Ok(self.rates_in_turn(&mut [Box::new(work)])?[0])
    }

    /// Calls of `work` a second over all of them: for calls of which a few do much more than the others.
    pub fn rate_overall<'a>(
        &self,
        work: impl FnMut() -> anyhow::Result<()> + 'a,
    ) -> anyhow::Result<f64> {
        let durations = &self.durations(&mut [Box::new(work)])?[0];
        Ok(durations.len() as f64 / durations.iter().sum::<f64>())
    }

    /// Calls a second of each of `works`, by the median. They take turns, so that a load of the machine affects them alike.
    pub fn rates_in_turn(&self, works: &mut [Work<'_>]) -> anyhow::Result<Vec<f64>> {
        let durations = self.durations(works)?;
        Ok(durations.iter().map(|it| 1.0 / median(it)).collect())
    }

    /// Seconds of each call of each work, in turn, after the warm-up.
    fn durations(&self, works: &mut [Work<'_>]) -> anyhow::Result<Vec<Vec<f64>>> {
        for _ in 0..self.warmup_calls {
            works.iter_mut().try_for_each(|work| work())?;
        }
        let (first, mut calls, mut seconds) = (Instant::now(), 0, vec![Vec::new(); works.len()]);
        while calls < self.calls_min || !self.is_spent(first) {
            for (work, seconds) in works.iter_mut().zip(&mut seconds) {
                let started = Instant::now();
                work()?;
                seconds.push(started.elapsed().as_secs_f64());
            }
            calls += 1;
        }
        Ok(seconds)
    }

    /// Whether something that began at `started` has been measured for long enough.
    pub fn is_spent(&self, started: Instant) -> bool {
        started.elapsed() >= self.time_min
    }
}

/// The middle value, or the mean of the two in the middle; NaN of none.
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
    fn a_median_is_in_the_middle() {
        assert_eq!(median(&[3.0, 1.0, 2.0]), 2.0);
        assert_eq!(median(&[4.0, 1.0, 2.0, 3.0]), 2.5);
        assert_eq!(median(&[7.0]), 7.0);
        assert!(median(&[]).is_nan());
    }

    #[test]
    fn works_take_turns_and_calls_are_counted_after_the_warm_up() {
        let effort = Effort {
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
        let durations = effort.durations(&mut [work('a'), work('b')]).unwrap();
        let counts: Vec<_> = durations.iter().map(Vec::len).collect();
        assert_eq!(counts, [3, 3]);
        assert_eq!(*calls.borrow(), "ababababab");
        assert!(effort.rate_by_median(|| anyhow::bail!("broken")).is_err());
    }
}
