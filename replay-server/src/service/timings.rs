//! Distributions of how long chunks wait and how old the weights are that acted, in fixed memory.

use std::{
    collections::VecDeque,
    time::{Duration, Instant},
};

use driml_protocol::{Quantiles, ReplayStatus, WeightsHeader};
use hdrhistogram::Histogram;

/// Accuracy of quantiles in decimal digits.
const DIGITS: u8 = 2;
/// Maximum value that is recorded; larger ones count as this one. In microseconds it is 12 days.
const VALUE_MAX: u64 = 1 << 40;
/// Maximum versions of weights whose arrival is remembered. Older versions count as replaced when the oldest of these arrived.
const VERSIONS_MAX: usize = 4096;

/// Distributions since the start.
#[derive(Default)]
pub(super) struct Timings {
    replies: Distribution,
    inserts: Distribution,
    weights_lag: Distribution,
    weights_lag_updates: Distribution,
    /// The version of each weights upload, its number of updates, and when it arrived; oldest first.
    versions: VecDeque<(u64, u64, Instant)>,
}

/// A distribution of counts, or of times in microseconds.
struct Distribution(Histogram<u64>);

impl Default for Distribution {
    fn default() -> Self {
        let empty = Histogram::new_with_bounds(1, VALUE_MAX, DIGITS);
        Self(empty.expect("bounds and digits that a histogram can have"))
    }
}

impl Distribution {
    fn record_time(&mut self, time: Duration) {
        let time = u64::try_from(time.as_micros()).unwrap_or(u64::MAX);
        self.0.saturating_record(time);
    }

    fn quantiles(&self, unit: f64) -> Option<Quantiles> {
        let at = |quantile| self.0.value_at_quantile(quantile) as f64 / unit;
        (!self.0.is_empty()).then(|| Quantiles {
            p50: at(0.5),
            p99: at(0.99),
            max: at(1.0),
        })
    }
}

impl Timings {
    pub(super) fn record_reply(&mut self, after: Duration) {
        self.replies.record_time(after);
    }

    /// Notes that a chunk was stored whose actions were chosen by weights of `version`.
    pub(super) fn record_insert(&mut self, version: u64, arrived: Instant, now: Instant) {
        self.inserts
            .record_time(now.saturating_duration_since(arrived));
        let Some(&(_, newest_updates, _)) = self.versions.back() else {
            return;
        };
        let newer = self.versions.partition_point(|&(it, ..)| it <= version);
        let replaced = self.versions.get(newer);
        let behind = replaced.map_or(Duration::ZERO, |&(_, _, at)| {
            now.saturating_duration_since(at)
        });
        self.weights_lag.record_time(behind);
        let acted = self.versions.get(newer.saturating_sub(1));
        let updates = acted.map_or(0, |&(_, updates, _)| newest_updates.saturating_sub(updates));
        self.weights_lag_updates.0.saturating_record(updates);
    }

    pub(super) fn record_weights(&mut self, weights: &WeightsHeader, now: Instant) {
        if self.versions.len() == VERSIONS_MAX {
            self.versions.pop_front();
        }
        self.versions
            .push_back((weights.version, weights.updates, now));
    }

    /// Moves the arrivals of weights by the length of a stop of this process.
    pub(super) fn leave_out_stop(&mut self, stop: Duration) {
        self.versions.iter_mut().for_each(|(.., at)| *at += stop);
    }

    pub(super) fn weights_age_s(&self, now: Instant) -> Option<f64> {
        let (_, _, arrived) = self.versions.back()?;
        Some(now.saturating_duration_since(*arrived).as_secs_f64())
    }

    pub(super) fn fill_status(&self, status: &mut ReplayStatus) {
        status.answer_ms = self.replies.quantiles(1e3);
        status.insert_ms = self.inserts.quantiles(1e3);
        status.weights_behind_s = self.weights_lag.quantiles(1e6);
        status.weights_behind_updates = self.weights_lag_updates.quantiles(1.0);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn weights_are_behind_from_when_newer_ones_came() {
        let (mut timings, start) = (Timings::default(), Instant::now());
        let at = |seconds| start + Duration::from_secs(seconds);
        let stored = |timings: &mut Timings, version, after_ms, now| {
            timings.record_insert(version, now - Duration::from_millis(after_ms), now);
            let mut status = ReplayStatus::default();
            timings.fill_status(&mut status);
            status
        };
        let behind = stored(&mut timings, 1, 7, at(1)).weights_behind_s;
        assert_eq!(behind, None, "no weights came here");
        for version in 1..=3 {
            let weights = WeightsHeader::new(version, 8 * version, &[]);
            timings.record_weights(&weights, at(10 * version));
        }
        for _ in 0..99 {
            stored(&mut timings, 3, 5, at(35));
        }
        let found = stored(&mut timings, 1, 500, at(35));
        let behind = found.weights_behind_s.unwrap();
        assert_eq!(behind.p50, 0.0, "the newest");
        // Version 2 came 15 seconds before.
        assert!((14.8..15.2).contains(&behind.max), "{behind:?}");
        let updates = found.weights_behind_updates.unwrap();
        assert_eq!((updates.p50, updates.max), (0.0, 16.0));
        let inserts = found.insert_ms.unwrap();
        let are_right = (4.9..5.1).contains(&inserts.p50) && inserts.max > 495.0;
        assert!(are_right, "{inserts:?}");
        let newer = stored(&mut timings, 9, 0, at(36)).weights_behind_updates;
        assert_eq!(newer.unwrap().p50, 0.0, "newer than all");
    }
}
