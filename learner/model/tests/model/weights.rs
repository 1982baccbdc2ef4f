//! Parameters: their initial values, round trips, and an error instead of a panic for every kind of broken file.
//! The two distributions of initial weights are tested in `init`.

use std::collections::HashMap;

use candle_core::{DType, Device, Tensor};
use driml_model::{ModelConfig, Parameters, Precision, TorsoName, WeightDtype};

use crate::support::{bits, bytes, parameters, policy, q_values, residual, rng, small, values};

fn all_bits(parameters: &Parameters) -> Vec<(String, Vec<u32>)> {
    let all = parameters.iter();
    all.map(|(name, var)| (name.to_owned(), bits(var)))
        .collect()
}

#[test]
fn the_seed_decides_the_weights() {
    let config = small();
    let first = parameters(&config, 5);
    assert_eq!(all_bits(&first), all_bits(&parameters(&config, 5)));
    assert_ne!(all_bits(&first), all_bits(&parameters(&config, 6)));
    let acting = parameters(&config.without_dim(), 5);
    // Heads do not change the torso's weights.
    assert_eq!(all_bits(&acting), all_bits(&first.without_dim().unwrap()));
}

/// The layers that start like PyTorch's linear layers, with random biases. All others start orthogonal with gain sqrt(2) and zero bias.
const UNIFORM: [&str; 5] = [
    "head",
    "dim.psi4.hidden",
    "dim.psi4.out",
    "dim.phi4.hidden",
    "dim.phi4.out",
];

#[test]
fn every_layer_starts_as_its_law_says() {
    let config = small();
    let parameters = parameters(&config, 5);
    let mut uniform = 0;
    for (name, shape) in config.parameter_shapes() {
        let (layer, part) = name.rsplit_once('.').unwrap();
        let (tensor, is_uniform) = (parameters.get(&name).unwrap(), UNIFORM.contains(&layer));
        let (rows, fan_in) = (shape[0], shape.iter().skip(1).product::<usize>());
        let is_within = |bound: f64| values(tensor).iter().all(|value| value.abs() <= bound);
        if is_uniform {
            let weight = parameters.get(&format!("{layer}.weight")).unwrap();
            let bound = 1.0 / (weight.dims()[1] as f64).sqrt();
            assert!(is_within(bound + 1e-7) && !is_within(0.7 * bound), "{name}");
            uniform += 1;
        } else if part == "bias" {
            assert!(is_within(0.0), "{name}");
        } else {
            let matrix = tensor.reshape((rows, fan_in)).unwrap();
            let other = matrix.t().unwrap();
            let gram = if rows <= fan_in {
                matrix.matmul(&other)
            } else {
                other.matmul(&matrix)
            };
            let side = rows.min(fan_in);
            for (at, value) in values(&gram.unwrap()).into_iter().enumerate() {
                let wanted = if at / side == at % side { 2.0 } else { 0.0 };
                let error = (value - wanted).abs();
                assert!(error < 1e-5, "{name} {shape:?}: {value} at {at}");
            }
        }
    }
    assert_eq!(uniform, 2 * UNIFORM.len());
}

#[test]
fn residual_blocks_start_smaller_where_that_is_asked_for() {
    let config = residual(TorsoName::Impala);
    let plain = ModelConfig {
        scale_blocks: false,
        ..config.clone()
    };
    let (scaled, plain) = (parameters(&config, 1), parameters(&plain, 1));
    let mut smaller = Vec::new();
    for (name, var) in plain.iter() {
        let (found, wanted) = (values(scaled.get(name).unwrap()), values(var));
        if found != wanted {
            smaller.push(name);
            for (found, wanted) in found.iter().zip(wanted) {
                // The network has four blocks, so the weights are halved.
                assert!((found - wanted / 2.0).abs() < 1e-7, "{name}");
            }
        }
    }
    let seconds = [(1, 1), (1, 2), (2, 1), (2, 2)]
        .map(|(stage, block)| format!("torso.stage{stage}.block{block}.conv2.weight"));
    assert_eq!(smaller, seconds);
    let fc = |torso| {
        let parameters = parameters(&residual(torso), 1);
        parameters.get("torso.fc.weight").unwrap().dims().to_vec()
    };
    assert_eq!(fc(TorsoName::Impala), [19, 3 * 4 * 7]);
    assert_eq!(fc(TorsoName::Impoola), [19, 7]);
}

#[test]
fn tensors_that_do_not_fit_are_named() {
    let config = small();
    let drawn = parameters(&config, 1);
    let named = drawn.iter();
    let named = named.map(|(name, var)| (name.to_owned(), var.as_tensor().clone()));
    let good: HashMap<String, Tensor> = named.collect();
    let nan = Tensor::new(&[f32::NAN; 19], &Device::Cpu).unwrap();
    let transposed = good["head.weight"].t().unwrap();
    let double = good["head.bias"].to_dtype(DType::F64).unwrap();
    let shapes = "has shape [19, 55], wanted [55, 19]";
    for (name, tensor, problem) in [
        ("torso.fc.bias", None, "is missing"),
        (
            "dim.extra",
            Some(nan.clone()),
            "is not part of this network",
        ),
        ("torso.fc.bias", Some(nan), "is NaN at index 0"),
        ("head.weight", Some(transposed), shapes),
        ("head.bias", Some(double), "has type F64, wanted F32"),
    ] {
        let mut changed = good.clone();
        changed.remove(name);
        changed.extend(tensor.map(|tensor| (name.to_owned(), tensor)));
        let error = Parameters::from_tensors(&config, |_| true, changed, &Device::Cpu).unwrap_err();
        assert_eq!(error.to_string(), format!("parameter {name}: {problem}"));
    }
}

/// Loads the file as parameters and as a policy. Both must fail, and the policy must stay as it was.
fn assert_rejected(config: &ModelConfig, file: &[u8], what: &str) {
    let loaded = Parameters::load_safetensors(config, |_| true, file, &Device::Cpu);
    assert!(loaded.is_err(), "{what}");
    let mut policy = policy(config, &parameters(config, 1), Precision::F32);
    let frames = bytes(2 * config.frame_len(), &mut rng(1));
    let before = q_values(&mut policy, config, &frames);
    assert!(policy.load(file).is_err(), "{what}");
    assert_eq!(q_values(&mut policy, config, &frames), before, "{what}");
}

#[test]
fn broken_files_are_errors() {
    let config = small().without_dim();
    let file = parameters(&config, 2).to_safetensors(|_| true).unwrap();
    let from_end = [file.len() / 2, 4, 1].map(|less| file.len() - less);
    for len in [0, 1, 7, 8, 9, 100].into_iter().chain(from_end) {
        assert_rejected(&config, &file[..len], &format!("cut to {len} bytes"));
    }
    let longer = [&file[..], &[0; 4]].concat();
    assert_rejected(&config, &longer, "four bytes too many");
    assert_rejected(&config, &[0xff; 64], "a header length beyond all memory");

    // `tensors_that_do_not_fit_are_named` has the other tensors that do not fit.
    let mut not_finite = file.clone();
    let last = not_finite.len() - 4;
    not_finite[last..].copy_from_slice(&f32::INFINITY.to_le_bytes());
    assert_rejected(&config, &not_finite, "an infinite weight");
}

#[test]
fn corrupted_headers_never_panic() {
    let config = small().without_dim();
    let file = parameters(&config, 2).to_safetensors(|_| true).unwrap();
    let load = |file: &[u8]| Parameters::load_safetensors(&config, |_| true, file, &Device::Cpu);
    let header = 8 + usize::try_from(u64::from_le_bytes(file[..8].try_into().unwrap())).unwrap();
    for at in 0..header {
        for flip in [1u8, 0x10, 0x80] {
            let mut broken = file.clone();
            broken[at] ^= flip;
            // A flipped bit may have no effect, for example in padding spaces. It must never cause a panic.
            drop(load(&broken));
        }
    }
}

#[test]
fn a_weight_that_is_too_large_for_its_type_is_named() {
    let parameters = parameters(&small(), 1);
    let weight = parameters.get("head.weight").unwrap();
    let large = (weight.ones_like().unwrap() * 1e5).unwrap();
    weight.set(&large).unwrap();
    let error = parameters.to_safetensors_as(WeightDtype::F16, |_| true);
    let said = error.unwrap_err().to_string();
    let words = "head.weight: is 100000 at index 0, too large for f16: learner.publish_dtype";
    assert!(said.contains(words), "{said}");
}
