//! The C51 head: its streams, its noise, and values for different supports; and loss layers.
//! The layers before the head are tested in `network`.

use candle_core::Result;
use driml_model::{Kernels, LossLayer, ModelConfig, Network, backward};

use crate::support::{NOISY, floats, frames, parameters, rng, small, small_with, values};

/// Every sigma starts at 0.5 / sqrt(19).
#[test]
fn a_noisy_layer_starts_with_its_sigma() {
    let noisy = small_with(NOISY);
    let drawn = parameters(&noisy, 1);
    for sigma in ["weight_sigma", "bias_sigma"] {
        let found = values(drawn.get(&format!("head.{sigma}")).unwrap());
        let is_sigma = |it: &f64| (it - 0.5 / 19f64.sqrt()).abs() < 1e-8;
        assert!(found.iter().all(is_sigma));
    }
}

/// `driml experiment stability` checks the values that our kernels compute over such supports.
#[test]
fn candle_s_values_over_a_support_far_from_0_are_those_of_our_kernels() {
    let (logits, parameters) = (floats(&[30, 5, 11], &mut rng(4)), parameters(&small(), 1));
    for v_min in [0.0, 1e3, -1e6] {
        let config = ModelConfig {
            v_min,
            v_max: v_min + 1.0,
            ..small()
        };
        let [ours, theirs] = [Kernels::FUSED, Kernels::Candle].map(|kernels| {
            let network = Network::new(&config, &parameters, kernels).unwrap();
            values(&network.q_values(&logits).unwrap())
        });
        // Half of a value's last place and the error of the f32 sums, for each.
        let allowed = 2.0 * (f64::from(v_min).abs() / 2f64.powi(24) + 4e-7);
        for (ours, theirs) in ours.iter().zip(theirs) {
            assert!((ours - theirs).abs() <= allowed, "{v_min}: {ours} {theirs}");
        }
    }
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
    let network = Network::new(&config, &parameters, Kernels::FUSED).unwrap();
    let features = network.features(&frames(&config, 4, &mut rng(5)));
    let f4 = features.unwrap().f4;
    let next = network.loss_layer("next", &f4).unwrap();
    let [weight, bias] =
        ["weight", "bias"].map(|part| parameters.get(&format!("dim.next.{part}")).unwrap());
    let wanted = values(&f4.matmul(&weight.t()?)?.broadcast_add(bias)?);
    for (next, wanted) in values(&next).into_iter().zip(wanted) {
        assert!((next - wanted).abs() < 1e-5, "{next}, {wanted}");
    }
    let found = backward(&next.sum_all()?, parameters.iter())?;
    assert_eq!(values(&found["dim.next.bias"]), [4.0; 6]);
    assert!(network.loss_layer("other", &f4).is_err());
    let acting = |config: &ModelConfig| config.without_dim().parameter_shapes();
    assert_eq!(acting(&config), acting(&small()));
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
