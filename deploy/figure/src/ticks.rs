//! Round tick values for an axis, and their labels.
//! This module draws nothing.

/// Returns about `count` round numbers in `low..=high`. The step is 1, 2 or 5 times a power of ten.
pub(super) fn linear(low: f64, high: f64, count: usize) -> Vec<f64> {
    let raw = (high - low) / count.max(1) as f64;
    if !(raw.is_finite() && raw > 0.0) {
        return vec![low];
    }
    let power = 10f64.powf(raw.log10().floor());
    // Choose the round step whose ratio to `raw` is closest to 1.
    let gap = |step: &f64| (step / raw).ln().abs();
    let steps = [1.0, 2.0, 5.0, 10.0].map(|times| times * power);
    let nearest = steps.into_iter().min_by(|a, b| gap(a).total_cmp(&gap(b)));
    let step = nearest.unwrap_or(power);
    let first = (low / step - 1e-9).ceil() as i64;
    let last = (high / step + 1e-9).floor() as i64;
    // Usually at most a few more than `count`; the limit keeps an unusual range from filling the memory.
    let all = first..=last.min(first + 50);
    all.map(|i| i as f64 * step).collect()
}

/// Returns the powers of ten in `low..=high`, with multiples of them if there are fewer than three; in a narrow range, as [`linear`] does.
pub(super) fn log(low: f64, high: f64) -> Vec<f64> {
    let (first, last) = (low.log10().floor() as i32, high.log10().ceil() as i32);
    let is_inside = |value: &f64| (low * 0.999..=high * 1.001).contains(value);
    for (count_min, times) in [
        (3, &[1.0][..]),
        (3, &[1.0, 2.0, 5.0]),
        (2, &[1.0, 1.5, 2.0, 3.0, 5.0, 7.0]),
    ] {
        let multiples = |power: i32| times.iter().map(move |times| times * 10f64.powi(power));
        let all = (first..=last.min(first + 50)).flat_map(multiples);
        let ticks: Vec<f64> = all.filter(is_inside).collect();
        if ticks.len() >= count_min {
            return ticks;
        }
    }
    linear(low, high, 4)
}

/// Labels of an axis are plain decimals if the largest tick is in this range, else they have powers of ten.
const DECIMAL_RANGE: std::ops::Range<f64> = 1e-4..1e10;

/// Formats the ticks of one axis: all with the same number of decimals, thousands and millions as k and M.
pub(super) fn labels(ticks: &[f64]) -> Vec<String> {
    let sizes = ticks.iter().map(|tick| tick.abs());
    let (_, largest) = bounds(sizes.clone()).unwrap_or_default();
    let (smallest, _) = bounds(sizes.filter(|size| *size > 0.0)).unwrap_or_default();
    let (divisor, unit) = unit_of(largest);
    let is_wide = largest / smallest >= 1000.0;
    let is_enough = |decimals: &i32| {
        let scale = 10f64.powi(*decimals);
        ticks.iter().map(|tick| tick / divisor).all(|value| {
            let rounded = (value * scale).round() / scale;
            (value - rounded).abs() <= 1e-6 * (largest / divisor).min(1.0)
        })
    };
    let decimals = (0..6).find(is_enough).unwrap_or(6) as usize;
    let label = |tick: &f64| match *tick {
        0.0 => "0".to_owned(),
        tick if is_wide => short_decimal(tick),
        tick if !DECIMAL_RANGE.contains(&largest) => power_of_ten(tick),
        tick => format!("{:.decimals$}{unit}", tick / divisor),
    };
    let labels = ticks.iter().map(label);
    labels.map(|it| it.replace('-', "\u{2212}")).collect()
}

/// Returns the smallest and the largest number; `None` if there are no numbers.
pub(super) fn bounds(values: impl Iterator<Item = f64>) -> Option<(f64, f64)> {
    let pairs = values.map(|value| (value, value));
    pairs.reduce(|(low, high), (value, _)| (low.min(value), high.max(value)))
}

fn unit_of(size: f64) -> (f64, &'static str) {
    match size {
        1e6.. => (1e6, "M"),
        1e4.. => (1e3, "k"),
        _ => (1.0, ""),
    }
}

/// Formats one number by itself, in as few characters as possible.
fn short_decimal(value: f64) -> String {
    if !DECIMAL_RANGE.contains(&value.abs()) {
        return power_of_ten(value);
    }
    let (divisor, unit) = unit_of(value.abs());
    format!("{}{unit}", (value / divisor * 1e6).round() / 1e6)
}

/// Formats a number as a few digits and a power of ten. Further digits would only show the rounding error of a multiple of the step.
fn power_of_ten(value: f64) -> String {
    let rounded = format!("{value:.6e}").parse().unwrap_or(value);
    format!("{rounded:e}")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ticks_are_round_and_inside() {
        assert_eq!(linear(0.0, 10.0, 5), [0.0, 2.0, 4.0, 6.0, 8.0, 10.0]);
        assert_eq!(linear(-1.2, 1.2, 4), [-1.0, -0.5, 0.0, 0.5, 1.0]);
        assert_eq!(linear(3.0, 3.0, 4), [3.0]);
        assert_eq!(log(1.0, 1000.0), [1.0, 10.0, 100.0, 1000.0]);
        assert_eq!(log(1.0, 25.0), [1.0, 2.0, 5.0, 10.0, 20.0]);
        assert_eq!(log(80.0, 300.0), [100.0, 150.0, 200.0, 300.0]);
        assert_eq!(
            labels(&log(3.99, 4.21)).join(" "),
            "4.00 4.05 4.10 4.15 4.20"
        );
    }

    #[test]
    fn labels_have_the_decimals_they_need_and_powers_of_ten_beyond() {
        for (ticks, expected) in [
            (&[0.0, 0.5, 1.0][..], "0 0.5 1.0"),
            (&[-2.0, 0.0, 2.0], "-2 0 2"),
            (&[0.0, 20_000.0, 40_000.0], "0 20k 40k"),
            (&[1.0, 10.0, 100.0, 1000.0], "1 10 100 1000"),
            (&[0.001, 0.01, 10.0], "0.001 0.01 10"),
            (&[0.0, 5e5, 1e6], "0 0.5M 1.0M"),
            (&[5e6, 1e7], "5M 10M"),
            (&linear(-1e-7, 1e-7, 4), "-1e-7 -5e-8 0 5e-8 1e-7"),
            (&[2e-5, 4e-5, 3.0 * 2e-5], "2e-5 4e-5 6e-5"),
            (&[0.0, 5e29, 1e30, 1.5e30], "0 5e29 1e30 1.5e30"),
            (&log(1e-9, 1e-6), "1e-9 1e-8 1e-7 1e-6"),
            (&[1.0, 1e4, 1e9, 1e12], "1 10k 1000M 1e12"),
        ] {
            assert_eq!(labels(ticks).join(" "), expected.replace('-', "\u{2212}"));
        }
    }
}
