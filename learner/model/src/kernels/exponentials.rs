//! Exponentials of many numbers at once, in f64: the soft clip of scores with its slope, and the weights of a softmax.
//! This module computes no sums, so that sums of its results have the same bits on every processor.

use crate::kernels::isa::{AnySimd, vectorized, with_simd};
use crate::kernels::precision::Precision;

/// Computes scores `c tanh(x / c)` of x = `scale` * dot, and their derivatives with respect to the dot.
///
/// `dots`, `scores` and `slopes` have the same length; the bound c is above 0. With `e = exp(-2 |x| / c)`:
/// `tanh = (1 - e) / (1 + e)`, and its slope is `4 e / (1 + e)^2`. Unlike `1 - tanh^2`, the slope keeps its precision where the
/// score saturates. `1 - e` is computed as `expm1`, which keeps its precision if the bound is far above the score. Both results
/// are within a relative 2e-15 for scores and bounds from 1e-150 to 1e150. A slope below 1e-307 is 0; a NaN gives NaN.
pub fn soft_clip(dots: &[f32], scale: f64, bound: f64, scores: &mut [f64], slopes: &mut [f64]) {
    let lens = [scores.len(), slopes.len()];
    assert_eq!(lens, [dots.len(); 2], "a score and a slope of each dot");
    with_simd!(AnySimd::fastest(Precision::F32), simd => clip(simd, dots, scale, bound, scores, slopes));
}

/// Replaces each value by `exp(value - max)`; no value may exceed `max`. The relative error is at most 1e-15
/// in addition to the rounding of the difference. A result below 1e-307 is 0; a NaN gives NaN.
pub fn exp_minus_max(values: &mut [f64], max: f64) {
    with_simd!(AnySimd::fastest(Precision::F32), simd => exp_of_differences(simd, values, max));
}

vectorized! {
    fn clip<S>(
        simd,
        dots: &'a [f32],
        scale: f64,
        bound: f64,
        scores: &'a mut [f64],
        slopes: &'a mut [f64],
    ) {
        for ((&dot, score), slope) in dots.iter().zip(scores).zip(slopes) {
            let x = f64::from(dot) * scale;
            let (e, exp_m1) = exp_pair(-2.0 * x.abs() / bound);
            let part = 1.0 / (1.0 + e);
            *score = bound * (-exp_m1 * part).copysign(x);
            *slope = scale * 4.0 * e * part * part;
        }
    }

    fn exp_of_differences<S>(simd, values: &'a mut [f64], max: f64) {
        for value in values {
            *value = exp_pair(*value - max).0;
        }
    }
}

/// Below this x, exp(x) is 0, so that no step computes with a subnormal number.
const X_MIN: f64 = -707.0;
/// Adding this constant rounds a number of magnitude below 2^51 to an integer, which is then in the sum's lowest bits.
const ROUNDER: f64 = 6_755_399_441_055_744.0;
/// ln 2 in two parts, the first with so few bits that its multiples up to 1100 are exact.
const LN_2_HIGH: f64 = f64::from_bits(0x3fe6_2e42_fee0_0000);
const LN_2_LOW: f64 = f64::from_bits(0x3dea_39ef_3579_3c76);

/// Computes exp(x) and exp(x) - 1 for x <= 0, without a branch, so that loops over it are vectorised.
///
/// x = k ln 2 + r with |r| <= ln 2 / 2. expm1(r) is a Taylor series up to the 13th power, with an error of 4e-18.
#[inline(always)]
fn exp_pair(x: f64) -> (f64, f64) {
    let is_tiny = x < X_MIN;
    let x = if is_tiny { X_MIN } else { x };
    let rounded = x * std::f64::consts::LOG2_E + ROUNDER;
    let k = rounded - ROUNDER;
    let r = x - k * LN_2_HIGH - k * LN_2_LOW;
    let mut tail = INVERSE_FACTORIALS[0];
    for factor in &INVERSE_FACTORIALS[1..] {
        tail = tail * r + factor;
    }
    let exp_m1 = r + r * r * tail;
    let power = f64::from_bits((rounded.to_bits() << 52).wrapping_add(1.0f64.to_bits()));
    let exp = power + power * exp_m1;
    let exp_minus_one = power * exp_m1 + (power - 1.0);
    if is_tiny {
        (0.0, -1.0)
    } else {
        (exp, exp_minus_one)
    }
}

/// 1/13!, 1/12!, .. 1/2!.
const INVERSE_FACTORIALS: [f64; 12] = {
    let mut factors = [0.0; 12];
    let (mut n, mut factorial) = (2, 1.0);
    while n <= 13 {
        factorial *= n as f64;
        factors[13 - n] = 1.0 / factorial;
        n += 1;
    }
    factors
};

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn exponentials_are_the_standard_library_s() {
        let multiples = (0..1020u32).map(|k| -f64::from(k) * std::f64::consts::LN_2);
        let even = [1e-9, 1.0, 40.0, -X_MIN]
            .map(|most| (0..=1000).map(move |i| -most * f64::from(i) / 1000.0));
        let edges = [0.0, -f64::MIN_POSITIVE, -1e-300];
        for x in multiples.chain(even.into_iter().flatten()).chain(edges) {
            let (exp, exp_m1) = exp_pair(x);
            for (found, wanted) in [(exp, x.exp()), (exp_m1, x.exp_m1())] {
                let is_close = (found - wanted).abs() <= 5e-16 * wanted.abs();
                assert!(is_close, "{x}: {found}, wanted {wanted}");
            }
        }
    }
}
