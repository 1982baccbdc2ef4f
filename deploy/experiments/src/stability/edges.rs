//! Inputs from the whole range of f32, often from the edges where its arithmetic changes; and helpers to compute references and errors.

use std::fmt;

use rand::{Rng, seq::IndexedRandom};

const RANGE_ENDS: [f32; 11] = [
    0.0,
    -0.0,
    1e-45,
    -1e-45,
    f32::MIN_POSITIVE,
    f32::EPSILON,
    1.0,
    -1.0,
    16_777_216.0,
    f32::MAX,
    f32::MIN,
];

/// Draws a finite number: of usual size, of any size, subnormal, a neighbour of a power of two, or an end of a range.
pub(super) fn draw_finite(rng: &mut impl Rng) -> f32 {
    match rng.random_range(0..10) {
        0..4 => rng.random_range(-10.0f32..10.0),
        4..6 => {
            // Every bit pattern is equally likely, except that patterns that are not finite lose a bit of their exponent.
            let bits = rng.random::<u32>();
            let is_lost = !f32::from_bits(bits).is_finite();
            f32::from_bits(bits ^ (u32::from(is_lost) << 30))
        }
        6 => f32::from_bits(rng.random::<u32>() & 0x807f_ffff),
        7..9 => {
            let exponent = rng.random_range(1u32..255);
            let size =
                f32::from_bits((exponent << 23).wrapping_add_signed(rng.random_range(-1..=1)));
            if rng.random() { -size } else { size }
        }
        _ => one_of(&RANGE_ENDS, rng),
    }
}

/// Draws `count` finite numbers: independent, all of usual size, all equal, from two values, or all of similar size.
pub(super) fn draw_finites(count: usize, rng: &mut impl Rng) -> Vec<f32> {
    match rng.random_range(0..6) {
        0..2 => (0..count).map(|_| draw_finite(rng)).collect(),
        2 => (0..count)
            .map(|_| rng.random_range(-10.0f32..10.0))
            .collect(),
        3 => vec![draw_finite(rng); count],
        4 => {
            let two = [draw_finite(rng), draw_finite(rng)];
            (0..count).map(|_| one_of(&two, rng)).collect()
        }
        _ => {
            let size = draw_finite(rng);
            let share = |_| size * rng.random_range(-1.0f32..1.0);
            (0..count).map(share).collect()
        }
    }
}

/// Draws as [`draw_finites`], and clamps to `-most..=most`.
pub(super) fn draw_clamped(count: usize, most: f32, rng: &mut impl Rng) -> Vec<f32> {
    let values = draw_finites(count, rng).into_iter();
    values.map(|x| x.clamp(-most, most)).collect()
}

/// Lists vectors of `count` numbers on which sums and exponentials may fail: all equal, shuffled ramps, one unlike the rest.
pub(super) fn extremes(count: usize) -> Vec<Vec<f32>> {
    let sizes = [0.0, 1e-45, 1e-38, 1e4, 1e12, 1e20, 1e38, f32::MAX];
    let equal = sizes.iter().flat_map(|&x| [x, -x]);
    let equal = equal.map(|x| vec![x; count]);
    let ramps = [1e-40, 1.0, 80.0, 104.0, 200.0, 1e4, 1e20, f32::MAX].map(|scale| {
        let place = |i: usize| (i * 37 % count) as f32 / count as f32;
        let values = (0..count).map(|i| place(i) * scale - scale / 2.0);
        values.collect::<Vec<_>>()
    });
    let outliers = [1e-45, f32::MIN].map(|rest| {
        let mut values = vec![rest; count];
        values[count / 2] = f32::MAX;
        values
    });
    equal.chain(ramps).chain(outliers).collect()
}

/// Draws probabilities of `count` atoms. They sum to 1, and some are 0 or tiny.
pub(super) fn draw_probs(count: usize, rng: &mut impl Rng) -> Vec<f32> {
    let mut weights: Vec<f64> = (0..count)
        .map(|_| match rng.random_range(0..3) {
            0 => 0.0,
            1 => rng.random::<f64>(),
            _ => rng.random::<f64>() * 1e-30,
        })
        .collect();
    weights[rng.random_range(0..count)] += 1e-3;
    let sum: f64 = weights.iter().sum();
    weights.iter().map(|weight| (weight / sum) as f32).collect()
}

/// Draws a probability: uniform, near 0 or 1, or a listed edge.
pub(super) fn draw_probability(rng: &mut impl Rng) -> f32 {
    match rng.random_range(0..4) {
        0 => rng.random(),
        1 => draw_finite(rng).abs().min(1.0),
        2 => 1.0 - draw_finite(rng).abs().min(1.0),
        _ => one_of(&[0.0, 1e-45, 1e-9, 0.5, 1.0 - f32::EPSILON / 2.0, 1.0], rng),
    }
}

/// Supports (low, high) from one float step to 2e30 wide, near 0 and far from it.
pub(super) const SUPPORTS: [(f32, f32); 14] = [
    (-10.0, 10.0),
    (0.0, 1.0),
    (1000.0, 1001.0),
    (1e6, 1e6 + 1.0),
    (1.0, 1.0f32.next_up()),
    (1e6, 1e6f32.next_up()),
    (-1e-6, 1e-6),
    (-1e6, 1e6),
    (-1.0, 1e6),
    (-1e30, 1e30),
    (0.0, 1e30),
    (0.0, 1e-45),
    (-1e6 - 1.0, -1e6),
    // Here low + (high - low) differs from high even in f64.
    (-9.174_887e29, -7.596_588_6),
];

/// Draws a support within 1e30: the usual one, one that is one float step wide, or any.
pub(super) fn draw_support(rng: &mut impl Rng) -> (f32, f32) {
    let end = |rng: &mut _| draw_finite(rng).clamp(-1e30, 1e30);
    match rng.random_range(0..4) {
        0 => (-10.0, 10.0),
        1 => {
            let low = end(rng).min(1e30f32.next_down());
            (low, low.next_up())
        }
        _ => loop {
            let (a, b) = (end(rng), end(rng));
            if a < b {
                break (a, b);
            }
        },
    }
}

/// The smallest normal f32. Errors of smaller values are relative to this.
pub(super) const MIN_NORMAL: f64 = f32::MIN_POSITIVE as f64;
pub(super) const F32_STEP: f64 = f32::EPSILON as f64;

/// Returns the softmax of a row, exp(x - max) / sum, with the largest x and the sum.
pub(super) fn softmax_f64(row: &[f64]) -> (Vec<f64>, f64, f64) {
    let max = row.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    let weights: Vec<f64> = row.iter().map(|x| (x - max).exp()).collect();
    let sum = exact_sum(weights.iter().copied());
    let shares = weights.iter().map(|weight| weight / sum);
    (shares.collect(), max, sum)
}

pub(super) fn to_f64(values: &[f32]) -> Vec<f64> {
    values.iter().map(|&x| f64::from(x)).collect()
}

pub(super) fn bits(values: &[f32]) -> Vec<u32> {
    values.iter().map(|x| x.to_bits()).collect()
}

/// Sums without cancellation errors, exact up to the last place. Source: Neumaier 1974.
pub(super) fn exact_sum(terms: impl IntoIterator<Item = f64>) -> f64 {
    let (mut sum, mut lost) = (0.0f64, 0.0);
    for term in terms {
        let next = sum + term;
        lost += if sum.abs() >= term.abs() {
            (sum - next) + term
        } else {
            (term - next) + sum
        };
        sum = next;
    }
    sum + lost
}

/// Returns the error of `found` relative to `expected`, or relative to the smallest normal f32 if that is larger.
pub(super) fn rel_error(found: f32, expected: f64) -> f64 {
    (f64::from(found) - expected).abs() / expected.abs().max(MIN_NORMAL)
}

/// Returns the largest error, or NaN if any is NaN.
pub(super) fn max_error(errors: impl IntoIterator<Item = f64>) -> f64 {
    let larger = |a: f64, b: f64| if b <= a || a.is_nan() { a } else { b };
    errors.into_iter().fold(0.0, larger)
}

/// Returns `error` if the condition holds, else NaN, which counts as the largest error.
pub(super) const fn nan_unless(holds: bool, error: f64) -> f64 {
    if holds { error } else { f64::NAN }
}

/// Draws infinity, -infinity or NaN.
pub(super) fn draw_nonfinite(rng: &mut impl Rng) -> f32 {
    one_of(&[f32::INFINITY, f32::NEG_INFINITY, f32::NAN], rng)
}

pub(super) fn one_of<T: Clone>(values: &[T], rng: &mut impl Rng) -> T {
    let value = values.choose(rng).cloned();
    value.expect("a list that is written out has an item")
}

/// Displays the first four values, and the number of values.
pub(super) struct Preview<'a>(pub(super) &'a [f32]);

impl fmt::Display for Preview<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let more = if self.0.len() > 4 { ", .." } else { "" };
        let first: Vec<_> = self.0.iter().take(4).map(|x| format!("{x:e}")).collect();
        write!(f, "[{}{more}] ({})", first.join(", "), self.0.len())
    }
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;

    use super::*;

    #[test]
    fn the_generator_likes_the_edges_and_is_never_infinite() {
        let rng = &mut ChaCha8Rng::seed_from_u64(1);
        let values: Vec<f32> = (0..20_000).map(|_| draw_finite(rng)).collect();
        assert!(values.iter().all(|x| x.is_finite()));
        let share = |wanted: fn(&f32) -> bool| {
            values.iter().filter(|x| wanted(x)).count() as f64 / values.len() as f64
        };
        assert!(share(|x| x.is_subnormal()) > 0.05);
        assert!(share(|x| x.abs() > 1e30) > 0.03);
        assert!(share(|x| x.to_bits() & 0x7f_ffff == 0x7f_ffff) > 0.03);
        assert!(share(|x| *x == 0.0) > 0.005);
        for _ in 0..2_000 {
            let (low, high) = draw_support(rng);
            assert!(low < high && low >= -1e30 && high <= 1e30, "{low}, {high}");
            assert!((0.0..=1.0).contains(&draw_probability(rng)));
            let sum: f32 = draw_probs(7, rng).iter().sum();
            assert!((sum - 1.0).abs() < 1e-6);
        }
        assert_eq!(exact_sum([1e16, 1.0, -1e16, 1e-3]), 1.001);
    }
}
