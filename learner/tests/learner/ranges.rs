//! Settings that float64 holds and float32 does not are rejected by name before anything is learned.
//! The tests beside each routine check the computation within the ranges.

use driml_learner::UpdateSettings;

use crate::synthetic::{ALL_DIM, settings};

/// A setting's name, values that are rejected, and values that are accepted.
const RANGES: &str = "
tanh_clip     : 0.0 1e-40 1e31 1e300           : 1e-30 20.0 1e15 1e30
max_grad_norm : 0.0 1e-300 1e16 2e19 1e300     : 1e-6 10.0 1e15
target_tau    : 0.0 1e-6 1e-300 1.000000001    : 1e-5 0.95 1.0
average_tau   : 0.0 1e-6 1e-300 1.000000001    : 1e-5 0.001 1.0
lambda.3t3    : -1e-9 1e31                     : 0.0 1.0 1e30
adam.lr       : 0.0 1e-46 1e34 1e38            : 1e-30 2.5e-4 1e33
adam.beta1    : -0.1 0.999999999 1.0           : 0.0 0.9 0.99999
adam.beta2    : -0.1 0.999999999 1.0           : 0.0 0.999 0.99999
adam.eps      : 0.0 1e-46 1e-30 1e39           : 1e-15 1e-8 1.0
";

/// Settings with one of them changed.
fn with_value(name: &str, value: f64) -> UpdateSettings {
    let mut all = toml::Table::try_from(settings(ALL_DIM)).unwrap();
    let (table, key) = match name.split_once('.') {
        Some((table, key)) => (all[table].as_table_mut().unwrap(), key),
        None => (&mut all, name),
    };
    table.insert(key.to_owned(), value.into());
    all.try_into().unwrap()
}

#[test]
fn what_float32_does_not_hold_is_refused_by_name() {
    for line in RANGES.trim().lines() {
        let [name, refused, taken] = line.split(" : ").collect::<Vec<_>>()[..] else {
            panic!("{line}")
        };
        let name = name.trim();
        for value in format!("{refused} NaN inf -inf").split_whitespace() {
            let settings = with_value(name, value.parse().unwrap());
            let said = settings.validate().expect_err(line).to_string();
            assert!(said.starts_with(&format!("{name} = ")), "{value}: {said}");
        }
        for value in taken.split_whitespace() {
            with_value(name, value.parse().unwrap()).validate().unwrap();
        }
    }
}
