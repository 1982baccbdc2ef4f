//! Numbers for property tests: all of an f32's range, and often where its arithmetic changes its ways.

use proptest::{num::f32 as floats, prelude::*};

/// A finite number: one of a usual size, one of any, a neighbour of a power of two, an end of a range.
pub(crate) fn any_finite() -> impl Strategy<Value = f32> + Clone {
    let of_any_size = floats::NORMAL | floats::SUBNORMAL | floats::ZERO;
    let near_power = (any::<bool>(), 1u32..255, -1i32..=1).prop_map(|(negative, exponent, off)| {
        let size = f32::from_bits((exponent << 23).wrapping_add_signed(off));
        if negative { -size } else { size }
    });
    let ends = prop::sample::select(vec![
        0.0,
        -0.0,
        1e-45,
        f32::MIN_POSITIVE,
        f32::EPSILON,
        1.0,
        f32::MAX,
        f32::MIN,
    ]);
    prop_oneof![4 => -10.0f32..10.0, 2 => of_any_size, 2 => near_power, 1 => ends]
}

/// `count` finite numbers: each on its own, all the same, or each one of two.
pub(crate) fn finites(
    count: impl Into<prop::collection::SizeRange>,
) -> impl Strategy<Value = Vec<f32>> {
    let count = count.into();
    let own = prop::collection::vec(any_finite(), count.clone());
    let usual = prop::collection::vec(-10.0f32..10.0, count.clone());
    let choices = prop::collection::vec(any::<bool>(), count);
    let few = (any_finite(), any_finite(), choices.clone())
        .prop_map(|(a, b, choices)| choices.iter().map(|&c| if c { a } else { b }).collect());
    let same = (any_finite(), choices).prop_map(|(x, choices)| vec![x; choices.len()]);
    prop_oneof![2 => own, 2 => usual, 1 => few, 1 => same]
}
