//! Statistics over few seeds and pairs: mean and spread, 95% intervals, tests whether two means differ, rank correlation, area under the
//! ROC curve. Every printed or drawn interval over seeds is computed here. Nothing is normalised.

pub(crate) mod over_games;

pub(crate) use driml_launch::stats::{Interval, interval};
use driml_launch::stats::{mean_and_deviation, student_quantile};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// Mean and standard deviation (n - 1) over seeds.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Spread {
    pub(crate) mean: f64,
    /// 0 for a single value.
    pub(crate) sd: f64,
    pub(crate) min: f64,
    pub(crate) max: f64,
    pub(crate) count: usize,
}

impl Spread {
    pub(crate) fn of(values: impl IntoIterator<Item = f64>) -> Option<Self> {
        let values: Vec<f64> = values.into_iter().collect();
        if values.is_empty() {
            return None;
        }
        let (mean, sd) = mean_and_deviation(&values);
        Some(Self {
            mean,
            sd: sd.unwrap_or(0.0),
            min: values.iter().copied().fold(f64::INFINITY, f64::min),
            max: values.iter().copied().fold(f64::NEG_INFINITY, f64::max),
            count: values.len(),
        })
    }
}

pub(crate) fn mean(values: &[f64]) -> Option<f64> {
    (!values.is_empty()).then(|| mean_and_deviation(values).0)
}

/// Returns the mean of `to` minus the mean of `from` with Welch's 95% interval, for which the degrees of freedom are rounded down. It has
/// no ends if either side has a single value. `None` if either is empty.
pub(crate) fn difference(from: &[f64], to: &[f64]) -> Option<Interval> {
    let [from, to] = [from, to].map(|it| Spread::of(it.iter().copied()));
    let (from, to) = from.zip(to)?;
    let mean = to.mean - from.mean;
    if from.count < 2 || to.count < 2 {
        return Some(Interval { mean, ends: None });
    }
    let variance_of_mean = |it: &Spread| it.sd.powi(2) / it.count as f64;
    let (a, b) = (variance_of_mean(&from), variance_of_mean(&to));
    let half_width = match a + b {
        0.0 => 0.0,
        sum => {
            let each = a * a / (from.count - 1) as f64 + b * b / (to.count - 1) as f64;
            student_quantile((sum * sum / each) as usize) * sum.sqrt()
        }
    };
    let ends = Some((mean - half_width, mean + half_width));
    Some(Interval { mean, ends })
}

/// Whether the means differ: 0 is outside the interval of their difference, and the exact permutation test gives p <= 5%. The second
/// condition is needed because a few values may nearly coincide, and then the interval is too narrow. With more than 20 values the interval
/// alone decides.
fn differ(from: &[f64], to: &[f64]) -> bool {
    let ends = difference(from, to).and_then(|it| it.ends);
    ends.is_some_and(|(low, high)| low > 0.0 || high < 0.0)
        && permutation_p_value(from, to).is_none_or(|it| it <= P_VALUE_MAX)
}

/// Returns as the end of a sentence whether `to` is better than its base `from`.
pub(crate) fn verdict(from: &[f64], to: &[f64]) -> &'static str {
    match differ(from, to) {
        false => "",
        true if mean(to) > mean(from) => ", better than its base",
        true => ", worse than its base",
    }
}

/// The number of simulated pairs of samples in [`false_positive_rate`].
const SIMULATIONS: usize = 2_000;

/// Returns the share of pairs of samples of these sizes of which [`differ`] is true although both have the same normal distribution.
pub(crate) fn false_positive_rate(from: usize, to: usize) -> f64 {
    // The seed is fixed, so that the same sizes give the same page.
    let mut rng = ChaCha8Rng::seed_from_u64(0);
    let mut sample = |n: usize| -> Vec<f64> { (0..n).map(|_| draw_normal(&mut rng)).collect() };
    let apart = (0..SIMULATIONS).filter(|_| differ(&sample(from), &sample(to)));
    apart.count() as f64 / SIMULATIONS as f64
}

/// Draws from the standard normal distribution. Source: Box and Muller 1958.
fn draw_normal(rng: &mut impl Rng) -> f64 {
    let radius = (-2.0 * (1.0 - rng.random::<f64>()).ln()).sqrt();
    radius * (std::f64::consts::TAU * rng.random::<f64>()).cos()
}

/// The largest p-value of the permutation test at which means count as apart.
const P_VALUE_MAX: f64 = 0.05;
/// The most values for which [`permutation_p_value`] tries all ways to deal them: at most 184,756.
const DEALT_VALUES_MAX: usize = 20;

/// Returns the p-value of the exact permutation test: the chance that the means are at least as far apart if all values are dealt to the
/// two sides at random. It assumes no distribution. `None` if either side is empty, or for more than 20 values.
fn permutation_p_value(from: &[f64], to: &[f64]) -> Option<f64> {
    let all = [from, to].concat();
    if from.is_empty() || to.is_empty() || all.len() > DEALT_VALUES_MAX {
        return None;
    }
    let total: f64 = all.iter().sum();
    let distance = |dealt: u32| {
        let chosen = (0..all.len()).filter(|at| dealt >> at & 1 == 1);
        let sum: f64 = chosen.map(|at| all[at]).sum();
        (sum / to.len() as f64 - (total - sum) / from.len() as f64).abs()
    };
    let observed = distance(((1 << to.len()) - 1) << from.len());
    // Sums in another order may differ in their last digits.
    let threshold = observed - 1e-9 * (1.0 + observed);
    let deals = (0..1u32 << all.len()).filter(|it| it.count_ones() as usize == to.len());
    let (far, near): (Vec<_>, Vec<_>) = deals.partition(|&deal| distance(deal) >= threshold);
    Some(far.len() as f64 / (far.len() + near.len()) as f64)
}

/// Returns the ranks of the values, from 1. Equal values share the mean of their ranks.
fn ranks(values: &[f64]) -> Vec<f64> {
    let mut order: Vec<usize> = (0..values.len()).collect();
    order.sort_by(|&a, &b| values[a].total_cmp(&values[b]));
    let mut ranks = vec![0.0; values.len()];
    let mut start = 0;
    for tie in order.chunk_by(|&a, &b| values[a] == values[b]) {
        let shared = start as f64 + (tie.len() + 1) as f64 / 2.0;
        for &index in tie {
            ranks[index] = shared;
        }
        start += tie.len();
    }
    ranks
}

/// Returns Spearman's rank correlation in -1..=1; `None` for fewer than three pairs, or if one side is constant.
pub(crate) fn rank_correlation(pairs: &[(f64, f64)]) -> Option<f64> {
    let x = ranks(&pairs.iter().map(|pair| pair.0).collect::<Vec<_>>());
    let y = ranks(&pairs.iter().map(|pair| pair.1).collect::<Vec<_>>());
    let mean = (pairs.len() as f64 + 1.0) / 2.0;
    let product = |a: &[f64], b: &[f64]| -> f64 {
        a.iter().zip(b).map(|(a, b)| (a - mean) * (b - mean)).sum()
    };
    let scale = (product(&x, &x) * product(&y, &y)).sqrt();
    (pairs.len() > 2 && scale > 0.0).then(|| product(&x, &y) / scale)
}

/// Returns the probability that a score of `positives` is above one of `negatives`, ties counting half: the area under the ROC curve.
///
/// It is 0.5 for scores without information, and `None` if either is empty. Scores must be finite.
pub(crate) fn auc(positives: &[f64], negatives: &[f64]) -> Option<f64> {
    if positives.is_empty() || negatives.is_empty() {
        return None;
    }
    let all: Vec<f64> = positives.iter().chain(negatives).copied().collect();
    let sum: f64 = ranks(&all)[..positives.len()].iter().sum();
    let (n, m) = (positives.len() as f64, negatives.len() as f64);
    Some((sum - n * (n + 1.0) / 2.0) / (n * m))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_difference_is_welchs() {
        // By hand: both sides have variance 1 and three values, so 4 degrees of freedom; 2.776 * sqrt(2 / 3) = 2.267.
        let found = difference(&[1.0, 2.0, 3.0], &[4.0, 5.0, 6.0]).unwrap();
        let (low, high) = found.ends.unwrap();
        assert!((low - 0.733).abs() < 1e-3 && (high - 5.267).abs() < 1e-3);
        assert_eq!(found.mean, 3.0);
        let (one, two) = (&[1.0], &[4.0, 5.0]);
        assert_eq!(difference(one, two).unwrap().ends, None);
        assert!(!differ(one, two));
        let equal = difference(&[1.0; 2], &[2.0; 2]).unwrap();
        assert_eq!(equal.ends, Some((1.0, 1.0)));
        assert_eq!(difference(&[], &[1.0]), None);
    }

    #[test]
    fn two_tests_call_fewer_apart_by_chance_than_one() {
        // Three and six values can be dealt in 84 ways, and 4 of 84 is the largest p-value up to 5%.
        let chance = false_positive_rate(6, 3);
        assert!((0.018..0.036).contains(&chance), "{chance}");
        assert_eq!(false_positive_rate(6, 1), 0.0);
    }

    #[test]
    fn rank_correlation_knows_order_and_ties() {
        // By hand: ranks of x 1, 2.5, 2.5, 4 and of y 1, 3, 2, 4.
        let by_hand = Some(4.5 / (4.5f64 * 5.0).sqrt());
        for (x, y, expected) in [
            ([1.0, 2.0, 3.0, 4.0], [10.0, 20.0, 50.0, 90.0], Some(1.0)),
            ([1.0, 2.0, 3.0, 4.0], [0.0, -1.0, -2.0, -5.0], Some(-1.0)),
            ([1.0; 4], [1.0; 4], None),
            ([1.0, 2.0, 2.0, 3.0], [1.0, 3.0, 2.0, 4.0], by_hand),
        ] {
            let pairs: Vec<_> = x.into_iter().zip(y).collect();
            let found = rank_correlation(&pairs);
            assert_eq!(found.is_none(), expected.is_none());
            assert!((found.unwrap_or(0.0) - expected.unwrap_or(0.0)).abs() < 1e-12);
        }
    }

    #[test]
    fn auc_is_the_share_of_pairs_in_order() {
        for (positives, negatives, expected) in [
            (&[2.0, 3.0][..], &[0.0, 1.0][..], Some(1.0)),
            (&[1.0], &[1.0], Some(0.5)),
            // Of the six pairs four are in order (2 > 1, 4 > 1, 4 > 3, 4 > 2), one is not (2 < 3), and one is a tie (2 = 2).
            (&[2.0, 4.0], &[1.0, 3.0, 2.0], Some(4.5 / 6.0)),
            (&[], &[1.0], None),
        ] {
            assert_eq!(auc(positives, negatives), expected);
        }
    }

    #[test]
    fn a_permutation_test_counts_deals() {
        let is = |found: Option<f64>, chance: f64| (found.unwrap() - chance).abs() < 1e-12;
        // Of the 10 ways to deal five values, one is as far apart in this direction, and one in the other.
        let found = permutation_p_value(&[1.0, 2.0, 3.0], &[4.0, 5.0]);
        assert!(is(found, 0.2), "{found:?}");
        let found = permutation_p_value(&[1.0, 1.1, 0.9, 1.2, 0.8, 1.0], &[3.0, 3.1, 2.9]);
        assert!(is(found, 1.0 / 84.0), "{found:?}");
        // Three values that nearly coincide with two of six: Welch's interval excludes 0, but the permutation test finds chance.
        let (from, to) = ([2.0, 2.02, 0.0, 0.0, 0.0, 0.02], [2.0, 2.01, 2.04]);
        let ends = difference(&from, &to).unwrap().ends;
        assert!(ends.unwrap().0 > 0.0 && !differ(&from, &to));
        let found = permutation_p_value(&from, &to);
        assert!(is(found, 9.0 / 84.0), "{found:?}");
        assert_eq!(permutation_p_value(&[1.0], &[]), None);
        assert_eq!(permutation_p_value(&[1.0; 20], &[2.0]), None);
    }
}
