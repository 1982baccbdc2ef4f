//! Settings that float64 holds and float32 does not are refused by name, before anything is learned with them.
//! What is computed within the ranges is tested beside each routine.

use driml_learner::LearnerSettings;

use crate::made_up::{ALL_DIM, settings};

type Change = fn(&mut LearnerSettings, f64);

/// A setting's name, how it is set, values that are refused and values that are not.
const RANGES: [(&str, Change, &[f64], &[f64]); 8] = [
    (
        "tanh_clip",
        |settings, value| settings.tanh_clip = value,
        &[0.0, 1e-40, 1e31, 1e300],
        &[1e-30, 20.0, 1e15, 1e30],
    ),
    (
        "max_grad_norm",
        |settings, value| settings.max_grad_norm = value,
        &[0.0, 1e-300, 1e16, 2e19, 1e300],
        &[1e-6, 10.0, 1e15],
    ),
    (
        "target_tau",
        |settings, value| settings.target_tau = value,
        &[0.0, 1e-6, 1e-300, 1.0 + 1e-9],
        &[1e-5, 0.95, 1.0],
    ),
    (
        "average_tau",
        |settings, value| settings.average_tau = Some(value),
        &[0.0, 1e-6, 1e-300, 1.0 + 1e-9],
        &[1e-5, 0.001, 1.0],
    ),
    (
        "adam.lr",
        |settings, value| settings.adam.lr = value,
        &[0.0, 1e-46, 1e39],
        &[1e-30, 2.5e-4, 1e38],
    ),
    (
        "adam.beta1",
        |settings, value| settings.adam.beta1 = value,
        &[-0.1, 1.0 - 1e-9, 1.0],
        &[0.0, 0.9, 0.99999],
    ),
    (
        "adam.beta2",
        |settings, value| settings.adam.beta2 = value,
        &[-0.1, 1.0 - 1e-9, 1.0],
        &[0.0, 0.999, 0.99999],
    ),
    (
        "adam.eps",
        |settings, value| settings.adam.eps = value,
        &[0.0, 1e-46, 1e-30, 1e39],
        &[1e-15, 1e-8, 1.0],
    ),
];

#[test]
fn what_float32_does_not_hold_is_refused_by_name() {
    for (name, set, refused, taken) in RANGES {
        let at = |value| {
            let mut settings = settings(ALL_DIM);
            set(&mut settings, value);
            settings.validate()
        };
        for &value in refused
            .iter()
            .chain(&[f64::NAN, f64::INFINITY, f64::NEG_INFINITY])
        {
            let said = at(value).expect_err(name).to_string();
            assert!(
                said.starts_with(&format!("{name} = ")),
                "{name} = {value}: {said}"
            );
        }
        for &value in taken {
            at(value).unwrap();
        }
    }
}
