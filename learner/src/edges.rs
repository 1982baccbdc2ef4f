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
