//! What is known of a run at one time: what every metric is taken from.
//! It names no metric.

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

/// How fast a run is.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Speed {
    /// Frames a second.
    pub frames: f64,
    /// Updates a second.
    pub updates: f64,
}

/// Mean and standard deviation.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Spread {
    /// Mean over the rows served.
    pub mean: f64,
    /// Standard deviation over the same rows.
    pub sd: f64,
}

/// A mean, and of how many returns it is.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MeanReturn {
    /// The mean return of the newest episodes.
    pub mean: f64,
    /// Episodes: 100, or as many as there were.
    pub of: usize,
}

/// The training's episodes so far, also over a resumption.
#[derive(Clone, Copy, Debug, Default)]
pub struct Episodes {
    /// How many ended.
    pub count: u64,
    /// Mean return of the last 100 of them, or of as many as there were; none before the first.
    pub mean_return: Option<MeanReturn>,
}

impl Moment<'_> {
    /// What the last update computed; none before the first, as a 0 would look like a loss.
    pub(crate) fn learned(&self, value: fn(&LearnerStatus) -> f64) -> Option<f64> {
        self.learner.filter(|it| it.updates > 0).map(value)
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
}
