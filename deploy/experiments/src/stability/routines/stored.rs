//! Weights as they travel: rounded to f16 or bf16, and read back.

use candle_core::Device;
use driml_model::{Parameters, StoredAs};
use rand::Rng;

use crate::stability::{
    check::{Context, Routine, Row},
    edges::finites,
    small,
};

/// Scalars in the head's weight that carries the values.
const HIDDEN: usize = 256;

const fn routine(stored: StoredAs) -> Routine {
    match stored {
        StoredAs::F32 => Routine {
            name: "f32 weights",
            range: "as published (learner.publish_as); finite",
        },
        StoredAs::F16 => Routine {
            name: "f16 weights",
            range: "as published (learner.publish_as); within 65,504",
        },
        StoredAs::Bf16 => Routine {
            name: "bf16 weights",
            range: "as published (learner.publish_as); within 3.3895e38",
        },
    }
}

/// Bits of significand, and the exponent of the least normal number.
const fn format(stored: StoredAs) -> (i32, i32) {
    match stored {
        StoredAs::F32 => (24, -126),
        StoredAs::F16 => (11, -14),
        StoredAs::Bf16 => (8, -126),
    }
}

/// The step of the type at `x`.
fn step_at(stored: StoredAs, x: f32) -> f64 {
    let (bits, least) = format(stored);
    // The exponent of a number that is not 0: halved or doubled until it lies between 1 and 2.
    let mut exponent = least;
    while f64::from(x.abs()) >= 2f64.powi(exponent + 1) {
        exponent += 1;
    }
    2f64.powi(exponent - bits + 1)
}

/// The nearest number of the type, ties to even.
fn nearest(stored: StoredAs, x: f32) -> f64 {
    let step = step_at(stored, x);
    (f64::from(x) / step).round_ties_even() * step
}

/// The values after a journey as weights.
fn travelled(stored: StoredAs, values: &[f32]) -> anyhow::Result<Vec<f32>> {
    let atoms = values.len().div_ceil(HIDDEN).max(2);
    let config = small::config(atoms, HIDDEN, (-1.0, 1.0));
    let mut all = vec![0.0; small::len(&config)];
    all[..values.len()].copy_from_slice(values);
    let bytes = small::parameters(&config, &all)?.to_safetensors_as(stored, |_| true)?;
    let read = Parameters::load_safetensors(&config, &bytes, &Device::Cpu)?;
    let mut read = small::values(&config, &read)?;
    read.truncate(values.len());
    Ok(read)
}

fn see(
    rounding: &mut Row,
    error: &mut Row,
    stored: StoredAs,
    values: &[f32],
) -> anyhow::Result<()> {
    for (&x, found) in values.iter().zip(travelled(stored, values)?) {
        let input = || format!("{x:e} became {found:e}");
        let same_sign = x.is_sign_negative() == found.is_sign_negative();
        rounding.must(same_sign && f64::from(found) == nearest(stored, x), input);
        let scale = f64::from(x.abs().max(stored.least_normal()));
        error.see((f64::from(found) - f64::from(x)) / scale, input);
    }
    Ok(())
}

/// Every number of the type, the middle between it and the next, and the floats beside that: all places where rounding turns.
fn turning_points(stored: StoredAs) -> Vec<f32> {
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

pub(super) fn check(context: &mut Context<'_>) -> anyhow::Result<Vec<Row>> {
    let mut rows = Vec::new();
    for stored in [StoredAs::F32, StoredAs::F16, StoredAs::Bf16] {
        let new = |extreme: &str| {
            [
                Row::new(
                    routine(stored),
                    extreme,
                    "weights that are not read back as the nearest number, ties to even, with their sign",
                    0.0,
                ),
                Row::new(
                    routine(stored),
                    extreme,
                    "error of a weight, as a share of it (of the least normal number below that)",
                    stored.error(),
                ),
            ]
        };
        if stored != StoredAs::F32 {
            let [mut rounding, mut error] = new(
                "every number of the type, the middles between them and the floats beside those",
            );
            see(&mut rounding, &mut error, stored, &turning_points(stored))?;
            rows.extend([rounding, error]);
            context.progress.advance(0)?;
        }
        let [mut rounding, mut error] = new("drawn");
        context.draw(0.005, |_, rng| {
            let mut values = finites(rng.random_range(1..4096), rng);
            let most = stored.largest();
            values.iter_mut().for_each(|x| *x = x.clamp(-most, most));
            see(&mut rounding, &mut error, stored, &values)
        })?;
        rows.push(rounding);
        if stored != StoredAs::F32 {
            rows.push(error);
        }
    }
    Ok(rows)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::stability::edges::shown;

    #[test]
    fn the_reference_rounds_as_the_types_do() {
        assert_eq!(nearest(StoredAs::F16, 1.0 + 1.0 / 2048.0), 1.0, "a tie");
        assert_eq!(
            nearest(StoredAs::F16, 1.0 + 3.0 / 2048.0),
            1.0 + 4.0 / 2048.0
        );
        assert_eq!(nearest(StoredAs::Bf16, 1.0 + 1.0 / 256.0), 1.0);
        assert_eq!(nearest(StoredAs::F16, 4e-8), 2f64.powi(-24));
        let all = turning_points(StoredAs::F16);
        assert_eq!(all.len(), 2 * (4 * 0x7bff + 1), "{}", shown(&all));
    }
}
