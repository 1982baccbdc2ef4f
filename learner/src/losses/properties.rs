//! The losses over all of an f32's range against float64 formulas of another form: what each promises in its own doc.

use proptest::prelude::*;

use super::{
    c51::{ENTRY_ERROR, KL_ERROR, SLOPE_ERROR, kl, softmax},
    info_nce::{LOSS_ERROR, info_nce, slope_error},
    projection::{MASS_ERROR, entry_error, project},
    scores::{self, CLIP_ERROR, Scores},
};
use crate::edges::{any_finite, finites};

/// exp(x - max) / sum of a row, in f64 and without a logarithm.
fn shares(row: &[f64]) -> Vec<f64> {
    let max = row.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    let weights: Vec<f64> = row.iter().map(|x| (x - max).exp()).collect();
    let sum: f64 = weights.iter().sum();
    weights.iter().map(|weight| weight / sum).collect()
}

fn widened(row: &[f32]) -> Vec<f64> {
    row.iter().map(|&x| f64::from(x)).collect()
}

/// Weights of `count` atoms that sum to 1, some of them 0.
fn law(count: usize) -> impl Strategy<Value = Vec<f32>> {
    let weight = prop_oneof![Just(0.0f64), 0.0f64..1.0, 0.0f64..1e-30];
    prop::collection::vec(weight, count).prop_map(|mut weights| {
        weights[0] += 1e-3;
        let sum: f64 = weights.iter().sum();
        weights.iter().map(|weight| (weight / sum) as f32).collect()
    })
}

/// Supports from one step of a float to 2e30 wide, near 0 and far from it.
fn supports() -> impl Strategy<Value = (f32, f32)> {
    let end = any_finite().prop_map(|x| x.clamp(-1e30, 1e30));
    let narrow = end.clone().prop_map(|x| {
        if x < 1e30 {
            (x, x.next_up())
        } else {
            (x.next_down(), x)
        }
    });
    let wide = (end.clone(), end).prop_filter_map("two ends", |(a, b)| match a.total_cmp(&b) {
        _ if a == b => None,
        std::cmp::Ordering::Less => Some((a, b)),
        _ => Some((b, a)),
    });
    prop_oneof![Just((-10.0, 10.0)), narrow, wide]
}

proptest! {
    #[test]
    fn softmax_is_right_to_the_last_place(logits in finites(2..80)) {
        let mut probs = vec![f32::NAN; logits.len()];
        softmax(&logits, &mut probs);
        for (p, expected) in probs.iter().zip(shares(&widened(&logits))) {
            let error = (f64::from(*p) - expected).abs();
            prop_assert!(error <= ENTRY_ERROR * expected.max(f32::MIN_POSITIVE.into()), "{p:e}, {expected:e}");
        }
    }

    #[test]
    fn kl_and_its_gradient_are_those_of_float64(
        (logits, target) in finites(2..60).prop_flat_map(|logits| {
            let atoms = logits.len();
            (Just(logits), law(atoms))
        }),
    ) {
        let mut gradient = vec![f32::NAN; logits.len()];
        let loss = kl(&logits, &target, logits.len(), &mut gradient);
        let mass: f64 = widened(&target).iter().sum();
        // The sum of terms t ln t - t (x - max) + t ln sum, its parts apart.
        let x = widened(&logits);
        let max = x.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        let log_sum = x.iter().map(|x| (x - max).exp()).sum::<f64>().ln();
        let (mut own, mut far) = (0.0, 0.0);
        for (x, t) in x.iter().zip(widened(&target)).filter(|(_, t)| *t > 0.0) {
            own += t * t.ln();
            far += t * (max - x);
        }
        let expected = own + far + mass * log_sum;
        prop_assert!((loss - expected).abs() <= KL_ERROR * (far + 10.0), "{loss:e}, {expected:e}");
        prop_assert!(loss.is_finite() && loss >= -1e-6, "{loss:e}");
        for ((g, p), t) in gradient.iter().zip(shares(&x)).zip(widened(&target)) {
            let expected = mass * p - t;
            let error = (f64::from(*g) - expected).abs();
            prop_assert!(error <= ENTRY_ERROR * expected.abs() + SLOPE_ERROR, "{g:e}, {expected:e}");
        }
    }

    /// A value that is no number ends in one that is none, which the update refuses.
    #[test]
    fn kl_hides_no_number_that_is_not_finite(
        mut logits in finites(2..20),
        bad in prop::sample::select(vec![f32::NAN, f32::INFINITY, f32::NEG_INFINITY]),
        at in any::<prop::sample::Index>(),
    ) {
        let atoms = logits.len();
        logits[at.index(atoms)] = bad;
        let mut gradient = vec![0.0; atoms];
        let loss = kl(&logits, &vec![1.0 / atoms as f32; atoms], atoms, &mut gradient);
        prop_assert!(!loss.is_finite(), "{loss}");
    }

    #[test]
    fn a_clipped_score_is_the_tanh_and_its_slope(
        dot in any_finite(),
        rkhs in 1usize..4096,
        exponent in -30.0f64..30.0,
    ) {
        let tanh_clip = 10f64.powf(exponent);
        let scores = Scores::new(rkhs, tanh_clip);
        let (score, slope) = scores.clip(dot);
        let ratio = f64::from(dot) * scores.scale / tanh_clip;
        let expected = tanh_clip * ratio.tanh();
        prop_assert!((score - expected).abs() <= CLIP_ERROR * expected.abs(), "{score:e}, {expected:e}");
        // The square of the cosh may be too large for a float where the slope is not yet too small for one.
        let expected = scores.scale / ratio.cosh() / ratio.cosh();
        let error = (slope - expected).abs();
        let allowed = scores::slope_error(ratio * tanh_clip, tanh_clip) * expected.max(scores::LEAST_SLOPE);
        prop_assert!(error <= allowed, "{slope:e}, {expected:e}");
    }

    #[test]
    fn info_nce_is_that_of_float64(
        (valid, dots) in (1usize..3, 1usize..7).prop_flat_map(|(locations, rows)| {
            let valid = prop::collection::vec(0u8..2, rows);
            (valid, finites(locations * rows * rows))
        }),
        tanh_clip in prop::sample::select(vec![1e-30, 1e-3, 1.0, 20.0, 1e6, 1e17, 1e30]),
    ) {
        let rows = valid.len();
        let scores = Scores::new(64, tanh_clip);
        let mut gradient = vec![f32::NAN; dots.len()];
        let loss = info_nce(&dots, &valid, scores, &mut gradient);
        let there: Vec<usize> = (0..rows).filter(|&row| valid[row] != 0).collect();
        let terms = there.len() * dots.len() / (rows * rows);
        let weight = 1.0 / terms.max(1) as f64;
        let (mut expected, mut largest) = (0.0, 0.0f64);
        let mut slopes = vec![0.0; dots.len()];
        for (at, row) in dots.chunks_exact(rows).enumerate() {
            let anchor = at % rows;
            if valid[anchor] == 0 {
                continue;
            }
            let ratio = |j: usize| f64::from(row[j]) * scores.scale / tanh_clip;
            let score = |j: usize| tanh_clip * ratio(j).tanh();
            let all: Vec<f64> = there.iter().map(|&j| score(j)).collect();
            let max = all.iter().copied().fold(f64::NEG_INFINITY, f64::max);
            let sum: f64 = all.iter().map(|s| (s - max).exp()).sum();
            expected += weight * (sum.ln() + (max - score(anchor)));
            largest = all.iter().fold(largest, |most, s| most.max(s.abs()));
            for (&j, p) in there.iter().zip(shares(&all)) {
                let target = if j == anchor { 1.0 } else { 0.0 };
                slopes[at * rows + j] = (p - target) * weight * scores.scale / ratio(j).cosh().powi(2);
            }
        }
        prop_assert!((loss - expected).abs() <= LOSS_ERROR * (largest + 10.0), "{loss:e}, {expected:e}");
        for (g, expected) in gradient.iter().zip(slopes) {
            let error = (f64::from(*g) - expected).abs();
            let allowed = slope_error(expected, weight, scores, largest);
            prop_assert!(error <= allowed, "{g:e}, {expected:e}");
        }
    }

    #[test]
    fn a_projection_is_the_sum_of_its_hats(
        (probs, (v_min, v_max)) in ((2usize..60).prop_flat_map(law), supports()),
        reward in prop_oneof![any_finite(), Just(f32::INFINITY), Just(f32::NEG_INFINITY)],
        discount in prop_oneof![
            0.0f32..=1.0,
            prop::sample::select(vec![0.0, 1e-45, 1e-40, f32::EPSILON, 1.0 - f32::EPSILON / 2.0, 1.0]),
        ],
    ) {
        let atoms = probs.len();
        let mut out = vec![f32::NAN; atoms];
        project(&probs, &[reward], &[discount], v_min, v_max, &mut out);
        // Each atom takes p times the height of its hat, 1 at itself and 0 at its neighbours, at the moved atom.
        let (low, high) = (f64::from(v_min), f64::from(v_max));
        let width = high - low;
        let place = |i: usize| i as f64 / (atoms - 1) as f64;
        let mut expected = vec![0.0; atoms];
        for (i, p) in widened(&probs).iter().enumerate() {
            let z = low + place(i) * width;
            let moved = (f64::from(reward) + f64::from(discount) * z).clamp(low, high);
            let share = (moved - low) / width;
            for (j, expected) in expected.iter_mut().enumerate() {
                let away = (share - place(j)).abs() * (atoms - 1) as f64;
                *expected += p * (1.0 - away).max(0.0);
            }
        }
        for (p, expected) in out.iter().zip(&expected) {
            prop_assert!(*p >= 0.0, "{out:?}");
            let error = (f64::from(*p) - expected).abs();
            prop_assert!(error <= entry_error(atoms, v_min, v_max), "{p:e}, {expected:e}");
        }
        let mass: f64 = widened(&out).iter().sum();
        let before: f64 = widened(&probs).iter().sum();
        prop_assert!((mass - before).abs() <= MASS_ERROR, "{before} became {mass}");
    }
}
