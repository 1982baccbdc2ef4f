//! The head: its streams, its noise, and values over the atoms of a support; and the layers of a loss.
//! What comes before it is `network`'s.

use candle_core::{Device, Result, Tensor};
use driml_model::{Backward, DimHeads, HeadNoise, Kernels, LossLayer, ModelConfig, Network};

use crate::support::{
    DUELING, NOISY, assert_close, floats, frames, parameters, rng, small, small_with, values,
    with_biases,
};

/// Logits as the paper writes them, V + A - mean_a A after two products, and the same of one action a row.
#[test]
fn a_dueling_head_is_the_sum_of_its_streams() -> Result<()> {
    let config = small_with(DUELING);
    let parameters = with_biases(&config);
    let network = Network::new(&config, &parameters).unwrap();
    let f4 = floats(&[6, config.hidden], &mut rng(4));
    let stream = |name: &str, outputs: &[usize]| -> Result<Tensor> {
        let weight = parameters.get(&format!("{name}.weight")).unwrap();
        let bias = parameters.get(&format!("{name}.bias")).unwrap();
        let outputs = [&[6], outputs].concat();
        let y = f4.relu()?.matmul(&weight.t()?)?.broadcast_add(bias)?;
        y.reshape(outputs)
    };
    let value = stream("head.value", &[1, 11])?;
    let advantage = stream("head.advantage", &[5, 11])?;
    let centred = advantage.broadcast_sub(&advantage.mean_keepdim(1)?)?;
    let wanted = centred.broadcast_add(&value)?;
    let found = network.logits(&f4).unwrap();
    assert_close("logits", &found, &wanted, 1e-6);
    let taken = [4u8, 0, 3, 3, 1, 2];
    let found = values(&network.taken_logits(&f4, &taken, None).unwrap());
    let wanted = values(&wanted);
    for (row, action) in taken.into_iter().enumerate() {
        let wanted = &wanted[(row * 5 + usize::from(action)) * 11..][..11];
        for (found, wanted) in found[row * 11..].iter().zip(wanted) {
            assert!((found - wanted).abs() < 1e-5, "{found} and {wanted}");
        }
    }
    Ok(())
}

/// Each layer as the paper writes it: (mu + sigma * eps) x, with the same noise for all rows.
#[test]
fn a_noisy_layer_is_its_mean_and_its_scaled_noise() -> Result<()> {
    let config = small_with(NOISY);
    let parameters = with_biases(&config);
    let network = Network::new(&config, &parameters).unwrap();
    let f4 = floats(&[6, config.hidden], &mut rng(4));
    let noise = HeadNoise::draw(&config, &mut rng(5)).unwrap();
    let (weight, bias) = noise.of_parameters(0);
    let [weight, bias] =
        [weight, bias].map(|it| it.into_iter().map(|it| it as f32).collect::<Vec<_>>());
    let part = |part: &str| parameters.get(&format!("head.{part}")).unwrap();
    // 0.5 / sqrt(19) everywhere, at the start of a run.
    for sigma in ["weight_sigma", "bias_sigma"] {
        let found = values(part(sigma));
        assert!(
            found
                .iter()
                .all(|&it| (it - 0.5 / 19f64.sqrt()).abs() < 1e-8)
        );
    }
    let weight = Tensor::from_vec(weight, (55, 19), &Device::Cpu)?;
    let bias = Tensor::from_vec(bias, 55, &Device::Cpu)?;
    let weight = (part("weight_mu").as_tensor() + (weight * part("weight_sigma").as_tensor())?)?;
    let bias = (part("bias_mu").as_tensor() + (bias * part("bias_sigma").as_tensor())?)?;
    let layer = |weight: &Tensor, bias: &Tensor| {
        let y = f4.relu()?.matmul(&weight.t()?)?.broadcast_add(bias)?;
        y.reshape((6, 5, 11))
    };
    let found = network.noisy_logits(&f4, Some(&noise)).unwrap();
    assert_close("noisy", &found, &layer(&weight, &bias)?, 1e-6);
    // Without noise its means alone, which is what evaluation takes.
    let mean = layer(part("weight_mu"), part("bias_mu"))?;
    assert_close("means", &network.logits(&f4).unwrap(), &mean, 1e-6);
    let plain = small();
    let plain = Network::new(&plain, &crate::support::parameters(&plain, 1)).unwrap();
    assert!(plain.noisy_logits(&f4, Some(&noise)).is_err());
    Ok(())
}

#[test]
fn q_values_are_expectations_over_the_atoms() -> Result<()> {
    let config = small();
    let network = Network::new(&config, &parameters(&config, 1)).unwrap();
    let logits = floats(&[3, 5, 11], &mut rng(4));
    let support = Tensor::from_vec(config.atoms_support(), 11, &Device::Cpu)?;
    assert_eq!(config.atoms_support()[0], -2.0);
    assert_eq!(config.atoms_support()[10], 3.0);
    let wanted = candle_nn::ops::softmax(&logits, 2)?
        .broadcast_mul(&support)?
        .sum(2)?;
    assert_close("values", &network.q_values(&logits).unwrap(), &wanted, 1e-6);
    Ok(())
}

/// An offset of the support is one of the values, whatever computes them.
#[test]
fn values_over_a_support_far_from_0_are_those_near_it_moved() {
    let near = ModelConfig {
        v_min: 0.0,
        v_max: 1.0,
        ..small()
    };
    let logits = floats(&[30, 5, 11], &mut rng(4));
    let parameters = parameters(&near, 1);
    let q_values = |config: &ModelConfig, kernels| {
        let network = Network::with_kernels(config, &parameters, kernels).unwrap();
        values(&network.q_values(&logits).unwrap())
    };
    let expected = q_values(&near, Kernels::FUSED);
    for (offset, v_min) in [(0.0, 0.0f32), (1e3, 1e3), (-1e6, -1e6)] {
        let far = ModelConfig {
            v_min,
            v_max: v_min + 1.0,
            ..small()
        };
        for kernels in [Kernels::FUSED, Kernels::Candle] {
            for (found, near) in q_values(&far, kernels).iter().zip(&expected) {
                let error = (found - offset - near).abs();
                // Half of a value's last place, and what the sums of f32 have by themselves.
                let allowed = offset.abs() / 2f64.powi(24) + 4e-7;
                assert!(error <= allowed, "{kernels:?} at {offset}: {error:e} off");
            }
        }
    }
}

/// Of the size that a head with PyTorch's first weights gives; an orthogonal head of gain sqrt(2) gives twice that.
///
/// A logit's variance is then v = (|relu(f4)|^2 + 1) / (3 * hidden), and for small logits that of a Q value is
/// v * mean(z^2) / atoms.
#[test]
fn the_first_q_values_are_small() {
    let config = ModelConfig {
        num_actions: 15,
        atoms: 51,
        v_min: -10.0,
        v_max: 10.0,
        hidden: 512,
        dim: DimHeads::NONE,
        ..small()
    };
    let support = config.atoms_support();
    let mean_square =
        |values: &[f64]| values.iter().map(|v| v * v).sum::<f64>() / values.len() as f64;
    let support: Vec<f64> = support.into_iter().map(f64::from).collect();
    let (mut found, mut expected) = (0.0, 0.0);
    for seed in 0..8 {
        let network = Network::new(&config, &parameters(&config, seed)).unwrap();
        let f4 = network
            .features(&frames(&config, 4, &mut rng(seed)))
            .unwrap()
            .f4;
        let logits = network.logits(&f4).unwrap();
        let relu = values(&f4.relu().unwrap());
        let norm = relu.iter().map(|f| f * f).sum::<f64>() / 4.0;
        let logit_variance = (norm + 1.0) / (3.0 * 512.0);
        assert!(logit_variance < 0.5, "{logit_variance}: not small");
        expected += logit_variance * mean_square(&support) / 51.0;
        found += mean_square(&values(&network.q_values(&logits).unwrap()));
    }
    let ratio = found / expected;
    assert!(
        (0.6..1.6).contains(&ratio),
        "Q^2 is {ratio} of what it should be"
    );
}

#[test]
fn a_support_begins_and_ends_where_it_says() {
    for (v_min, v_max) in [
        (-10.0, 10.0),
        (0.1, 0.7),
        (-9.174_887e29, -7.596_588_6),
        (1e6, 1_000_001.0),
    ] {
        let config = ModelConfig {
            v_min,
            v_max,
            ..small()
        };
        let support = config.atoms_support();
        assert_eq!((support[0], support[10]), (v_min, v_max));
        assert!(support.is_sorted(), "{support:?}");
    }
}

fn loss_layer(name: &str, inputs: usize, outputs: usize) -> LossLayer {
    let name = name.to_owned();
    LossLayer {
        name,
        inputs,
        outputs,
    }
}

#[test]
fn a_loss_s_own_layer_is_linear_and_only_the_online_network_s() -> Result<()> {
    let config = ModelConfig {
        loss_layers: vec![loss_layer("next", 19, 6)],
        ..small()
    };
    let parameters = parameters(&config, 1);
    let network = Network::new(&config, &parameters).unwrap();
    let f4 = network
        .features(&frames(&config, 4, &mut rng(5)))
        .unwrap()
        .f4;
    let next = network.loss_layer("next", &f4).unwrap();
    let [weight, bias] =
        ["weight", "bias"].map(|part| parameters.get(&format!("dim.next.{part}")).unwrap());
    assert_close(
        "next",
        &next,
        &f4.matmul(&weight.t()?)?.broadcast_add(bias)?,
        1e-5,
    );
    let mut found = Backward::of(&next.sum_all()?)?;
    assert_close(
        "bias",
        &found.remove(bias)?.unwrap(),
        &Tensor::full(4f32, 6, &Device::Cpu)?,
        1e-6,
    );
    assert!(network.loss_layer("other", &f4).is_err());
    assert_eq!(
        config.without_dim().parameter_shapes(),
        small().without_dim().parameter_shapes()
    );
    Ok(())
}

#[test]
fn a_loss_s_own_layer_has_a_size_and_a_name_that_no_other_layer_has() {
    let fails = |layers: &[LossLayer]| {
        let config = ModelConfig {
            loss_layers: layers.to_vec(),
            ..small()
        };
        assert!(config.validate().is_err(), "{layers:?}");
    };
    for name in ["", "psi3", "Next", "a.b"] {
        fails(&[loss_layer(name, 1, 1)]);
    }
    fails(&[loss_layer("next", 1, 0)]);
    fails(&[loss_layer("next", 1, 1), loss_layer("next", 1, 1)]);
}
