//! The whole network: determinism, and errors for wrong inputs.
//! The learner's `parity` tests compare values and gradients of this project's kernels and of candle's with another framework.

use candle_core::{DType, Device, Tensor};
use driml_model::{
    DimHeads, HeadNoise, Kernels, ModelConfig, ModelError, Network, Parameters, Precision,
    TorsoName, backward,
};

use crate::support::{bits, configs, floats, frames, parameters, pool, residual, rng, small};

#[test]
fn features_and_gradients_have_the_same_bits_for_any_number_of_threads() {
    for (precision, config) in Precision::ALL
        .into_iter()
        .flat_map(|precision| configs().map(move |config| (precision, config)))
    {
        let streams = if config.head.dueling { 2 } else { 1 };
        let noise = HeadNoise::draw(&config, &mut rng(3));
        let head = streams * if noise.is_some() { 4 } else { 2 };
        let parameters = parameters(&config, 7);
        let kernels = Kernels::Fused(precision);
        let network = Network::new(&config, &parameters, kernels).unwrap();
        let batch = frames(&config, 61, &mut rng(2));
        let run = || {
            let features = network.features(&batch).unwrap();
            let logits = network.logits(&features.f4, noise.as_ref()).unwrap();
            let phi3 = network.phi3(features.require_f3().unwrap()).unwrap();
            let [logits_loss, phi3_loss] =
                [&logits, &phi3].map(|it| it.sqr().unwrap().sum_all().unwrap());
            let grads = backward(&(logits_loss + phi3_loss).unwrap(), parameters.iter());
            let grads = grads.unwrap();
            (bits(&logits), grads.values().map(bits).collect::<Vec<_>>())
        };
        let one = pool(1).install(run);
        let shapes = config.parameter_shapes();
        let torso = shapes.iter().filter(|it| it.0.starts_with("torso."));
        assert_eq!(one.1.len(), torso.count() + head + 5, "torso, head, phi3");
        for threads in [2, 3] {
            assert!(pool(threads).install(run) == one, "{threads} threads");
        }
    }
}

#[test]
fn heads_that_are_left_out_are_not_there() {
    let without = |change: fn(&mut DimHeads)| {
        let mut config = small();
        change(&mut config.dim);
        config
    };
    let has_layer = |config: &ModelConfig, layer: &str| {
        let mut shapes = config.parameter_shapes().into_iter();
        shapes.any(|(name, _)| name.starts_with(layer))
    };
    let config = without(|dim| (dim.psi3, dim.phi4) = (false, false));
    assert!(!has_layer(&config, "dim.psi3") && !has_layer(&config, "dim.phi4"));
    let network = Network::new(&config, &parameters(&config, 1), Kernels::FUSED).unwrap();
    let features = network.features(&frames(&config, 2, &mut rng(5))).unwrap();
    let actions = Tensor::zeros(2, DType::I64, &Device::Cpu).unwrap();
    let psi3 = network.psi3(features.require_f3().unwrap(), &actions);
    assert!(matches!(psi3, Err(ModelError::NoHead("psi3"))));
    let phi4 = network.phi4(&features.f4);
    assert!(matches!(phi4, Err(ModelError::NoHead("phi4"))));
    assert!(network.psi4(&features.f4, &actions).is_ok());

    let without_psi = without(|dim| (dim.psi3, dim.psi4) = (false, false));
    assert!(!has_layer(&without_psi, "dim.action"));
}

#[test]
fn inputs_that_do_not_fit_are_errors() {
    let config = small();
    let network = Network::new(&config, &parameters(&config, 1), Kernels::FUSED).unwrap();
    let batch = frames(&config, 2, &mut rng(6));
    let features = network.features(&batch).unwrap();
    let not_bytes = batch.to_dtype(DType::F32);
    for bad in [not_bytes, batch.narrow(1, 0, 35), batch.get(0)] {
        assert!(network.features(&bad.unwrap()).is_err());
    }
    for wrong in [5i64, -1] {
        let actions = Tensor::new(&[0, wrong], &Device::Cpu).unwrap();
        let psi4 = network.psi4(&features.f4, &actions);
        assert!(matches!(psi4, Err(ModelError::Input(_))));
    }
    let actions = Tensor::new(&[0i64, 1, 2], &Device::Cpu).unwrap();
    let of_three = network.psi4(&features.f4, &actions);
    assert!(of_three.is_err(), "three actions for two rows");
    for taken in [&[0, 5][..], &[0]] {
        assert!(network.taken_logits(&features.f4, taken, None).is_err());
    }
    let none = features.f4.narrow(0, 0, 0).unwrap();
    assert!(network.taken_logits(&none, &[], None).is_err());
    let narrow = features.f4.narrow(1, 0, 5).unwrap();
    assert!(network.logits(&narrow, None).is_err());
    let [psi, phi] = [[5, 3, 7], [5, 2, 7]].map(|shape| floats(&shape, &mut rng(7)));
    assert!(Kernels::FUSED.dot_products(&psi, &phi).is_err());
    let config = residual(TorsoName::Impala);
    let network = Network::new(&config, &parameters(&config, 1), Kernels::FUSED).unwrap();
    let none = network.features(&frames(&config, 0, &mut rng(6)));
    let said = none.unwrap_err().to_string();
    assert!(said.contains("stages on images"), "{said}");
}

/// The settings' snapshot of refusals has the answers to configurations that can be set.
#[test]
fn configurations_that_cannot_work_are_errors() {
    let fails = |config: ModelConfig| {
        let checked = config.validate();
        assert!(matches!(checked, Err(ModelError::Config(_))), "{config:?}");
        assert!(Parameters::init(&config, &mut rng(1), &Device::Cpu).is_err());
    };
    let changes: [fn(&mut ModelConfig); 4] = [
        |config| config.height = 11,
        |config| config.input_channels = usize::MAX,
        |config| config.num_actions = 256,
        |config| *config = residual(TorsoName::Nature),
    ];
    assert!(small().validate().is_ok());
    for change in changes {
        let mut config = small();
        change(&mut config);
        fails(config);
    }
    for torso in [TorsoName::Impala, TorsoName::Impoola] {
        let residual = residual(torso);
        assert!(residual.validate().is_ok());
        let with = |channels: &[usize]| ModelConfig {
            channels: channels.to_vec(),
            ..residual.clone()
        };
        for channels in [&[usize::MAX][..], &[65_536]] {
            fails(with(channels));
        }
        // The smallest possible frame.
        let one = ModelConfig {
            height: 1,
            width: 1,
            ..with(&[1, 2, 3])
        };
        assert!(one.validate().is_ok() && one.f3_shape() == (1, 1, 3));
    }
}
