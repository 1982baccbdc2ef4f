//! Weights as the learner publishes them: rounded to f32, f16 or bf16, and read back.

use candle_core::Device;
use driml_model::{Parameters, WeightDtype};

use crate::{small, stability::property::*};

const NEAREST: &str = "weights not read as the nearest, ties to even, with their sign";
const ALL: &str = "every number of the type, the middles between them and the floats beside those";

pub(super) fn properties() -> Vec<Property> {
    let property = |routine, range, stored: WeightDtype| {
        let property = Property::new(routine, range)
            .promise(NEAREST, 0.0)
            .promise("a weight, as a share of it", stored.rounding_error());
        let property = match stored {
            WeightDtype::F32 => property,
            _ => property.check(ALL, Listed, move |cases| {
                check_stored(cases, stored, &turning_points(stored))
            }),
        };
        property.check("drawn", Drawn(0.005), move |cases| {
            let count = cases.rng.random_range(1..4096);
            let values = draw_clamped(count, stored.largest(), &mut cases.rng);
            check_stored(cases, stored, &values)
        })
    };
    let [f32, f16, bf16] = [
        "as published (learner.publish_dtype); finite",
        "as published (learner.publish_dtype); within 65,504",
        "as published (learner.publish_dtype); within 3.3895e38",
    ];
    vec![
        property("f32 weights", f32, WeightDtype::F32),
        property("f16 weights", f16, WeightDtype::F16),
        property("bf16 weights", bf16, WeightDtype::Bf16),
    ]
}

/// The length of a row of the head's weight, which carries the values.
const HIDDEN: usize = 256;

/// Returns the distance between neighbouring numbers of the type at `x`.
fn step_at(stored: WeightDtype, x: f32) -> f64 {
    // The bits of the significand, and the exponent of the smallest normal number.
    let (bits, least) = match stored {
        WeightDtype::F32 => (24, -126),
        WeightDtype::F16 => (11, -14),
        WeightDtype::Bf16 => (8, -126),
    };
    let exponent = (x.abs().to_bits() >> 23) as i32 - 127;
    2f64.powi(exponent.max(least) - bits + 1)
}

/// Returns every number of the type, every midpoint between two of them, and the floats beside the midpoints, with both signs.
fn turning_points(stored: WeightDtype) -> Vec<f32> {
    let mut values = Vec::new();
    let mut x = 0.0f32;
    while x < stored.largest() {
        let step = step_at(stored, x);
        let middle = (f64::from(x) + step / 2.0) as f32;
        values.extend([x, middle.next_down(), middle, middle.next_up()]);
        x = (f64::from(x) + step) as f32;
    }
    values.push(stored.largest());
    values.retain(|x| *x <= stored.largest());
    values.iter().flat_map(|&x| [x, -x]).collect()
}

/// Saves and loads the values as weights, and counts their errors.
fn check_stored(cases: &mut Cases<'_>, stored: WeightDtype, values: &[f32]) -> anyhow::Result<()> {
    let config = small::config(values.len().div_ceil(HIDDEN).max(2), HIDDEN, (-1.0, 1.0));
    let bytes = small::parameters(&config, values)?.to_safetensors_as(stored, |_| true)?;
    let read = Parameters::load_safetensors(&config, |_| true, &bytes, &Device::Cpu)?;
    for (&x, found) in values.iter().zip(small::scalars(&config, &read)?) {
        let step = step_at(stored, x);
        let nearest = (f64::from(x) / step).round_ties_even() * step;
        let has_its_sign = x.is_sign_negative() == found.is_sign_negative();
        let is_nearest = has_its_sign && f64::from(found) == nearest;
        let scale = f64::from(x.abs().max(stored.min_normal()));
        let error = (f64::from(found) - f64::from(x)) / scale;
        let input = format_args!("{x:e} became {found:e}");
        cases.record_errors(input, [f64::from(!is_nearest), error])?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_finite_f16_has_its_turning_points() {
        assert_eq!(turning_points(WeightDtype::F16).len(), 2 * (4 * 0x7bff + 1));
    }
}
