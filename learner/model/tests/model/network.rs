//! The whole network: the DIM heads against their plain formula, determinism, and errors for what does not fit.
//! Values against another framework are in `parity`.

use candle_core::{DType, Device, Result, Tensor};
use driml_model::{
    Backward, ConvLayer, DimHeads, HeadNoise, Kernels, ModelConfig, ModelError, Network,
    Parameters, Precision,
};

use crate::support::{
    DUELING, NOISY, NOISY_DUELING, assert_close, bits, frames, parameters, rng, small, small_with,
    values, variable,
};

/// out(relu(hidden(x))) + skip(x) by candle's operations, x [rows, in].
fn stock_block(parameters: &Parameters, name: &str, x: &Tensor) -> Result<Tensor> {
    let layer = |part: &str, x: &Tensor| {
        let y = x.matmul(
            &parameters
                .get(&format!("{name}.{part}.weight"))
                .unwrap()
                .t()?,
        )?;
        match parameters.get(&format!("{name}.{part}.bias")) {
            Some(bias) => y.broadcast_add(bias),
            None => Ok(y),
        }
    };
    layer("out", &layer("hidden", x)?.relu()?)? + layer("skip", x)?
}

/// Initial biases are 0; tests want them to matter.
fn with_biases(config: &ModelConfig) -> Parameters {
    let (parameters, rng) = (parameters(config, 7), &mut rng(8));
    for (name, var) in parameters
        .iter()
        .filter(|(name, _)| name.ends_with(".bias") || name.ends_with(".bias_mu"))
    {
        let values = crate::support::floats(var.dims(), rng);
        var.set(&values)
            .unwrap_or_else(|error| panic!("{name}: {error}"));
    }
    parameters
}

/// Every output of the network for a batch, one after the other, and the gradients of their weighted sum.
fn outputs_and_gradients(
    config: &ModelConfig,
    parameters: &Parameters,
    kernels: Kernels,
) -> Result<(Vec<Tensor>, Backward)> {
    let network = Network::with_kernels(config, parameters, kernels).unwrap();
    let features = network.features(&frames(config, 6, &mut rng(1))).unwrap();
    let actions = Tensor::new(&[0u32, 4, 2, 2, 1, 3], &Device::Cpu)?;
    let noise = HeadNoise::draw(config, &mut rng(3));
    let logits = network.noisy_logits(&features.f4, noise.as_ref()).unwrap();
    let outputs = vec![
        network.q_values(&logits).unwrap(),
        logits,
        network.psi3(features.local().unwrap(), &actions).unwrap(),
        network.phi3(features.local().unwrap()).unwrap(),
        network.psi4(&features.f4, &actions).unwrap(),
        network.phi4(&features.f4).unwrap(),
        features.local().unwrap().clone(),
        features.f4,
    ];
    let mut total = Tensor::new(0f32, &Device::Cpu)?;
    for (seed, output) in (10..).zip(&outputs[1..]) {
        let weights = crate::support::floats(output.dims(), &mut rng(seed));
        total = (total + (output * weights)?.sum_all()?)?;
    }
    Ok((outputs, Backward::of(&total)?))
}

#[test]
fn candle_s_own_operations_give_the_same_with_gradients() -> Result<()> {
    // Strides that divide their kernels and one that does not; a stride of 1; a kernel of 1.
    let odd = small();
    let even = ModelConfig {
        conv: [(5, 8, 4), (7, 4, 2), (6, 1, 1)]
            .map(|(out, kernel, stride)| ConvLayer {
                out,
                kernel,
                stride,
            })
            .to_vec(),
        ..small()
    };
    for config in [
        odd,
        even,
        small_with(DUELING),
        small_with(NOISY),
        small_with(NOISY_DUELING),
    ] {
        let parameters = with_biases(&config);
        let (ours, mut our_gradients) =
            outputs_and_gradients(&config, &parameters, Kernels::FUSED)?;
        let (theirs, mut their_gradients) =
            outputs_and_gradients(&config, &parameters, Kernels::Candle)?;
        for (index, (ours, theirs)) in ours.iter().zip(&theirs).enumerate() {
            assert_close(&format!("output {index}"), theirs, ours, 1e-6);
        }
        for (name, var) in parameters.iter() {
            let (ours, theirs) = (our_gradients.remove(var)?, their_gradients.remove(var)?);
            assert_close(name, &theirs.unwrap(), &ours.unwrap(), 2e-6);
        }
    }
    Ok(())
}

#[test]
fn the_dim_heads_follow_their_formula_with_gradients() -> Result<()> {
    for action in [true, false] {
        let mut config = small();
        config.dim.action = action;
        let parameters = with_biases(&config);
        let network = Network::new(&config, &parameters).unwrap();
        let features = network.features(&frames(&config, 6, &mut rng(1))).unwrap();
        let (f3, f4) = (features.local().unwrap().detach(), features.f4.detach());
        let (h, w, c) = config.local_shape();
        assert_eq!(f3.dims(), [6, h, w, c]);
        let indices = [0u32, 4, 2, 2, 1, 3];
        let actions = Tensor::new(&indices, &Device::Cpu)?;

        let flat = f3.reshape((6 * h * w, c))?;
        let (mut local, mut global) = (flat.clone(), f4.clone());
        if action {
            let one_hot = Tensor::eye(5, DType::F32, &Device::Cpu)?.index_select(&actions, 0)?;
            let embedded = stock_block(&parameters, "dim.action", &one_hot)?;
            let tiled = embedded
                .unsqueeze(1)?
                .repeat((1, h * w, 1))?
                .reshape((6 * h * w, ()))?;
            local = Tensor::cat(&[&flat, &tiled], 1)?;
            global = Tensor::cat(&[&f4, &embedded], 1)?;
        }
        let by_location = |x: Tensor| x.reshape((6, h * w, config.rkhs));
        let pairs = [
            (
                "psi3",
                network.psi3(&f3, &actions),
                by_location(stock_block(&parameters, "dim.psi3", &local)?)?,
            ),
            (
                "phi3",
                network.phi3(&f3),
                by_location(stock_block(&parameters, "dim.phi3", &flat)?)?,
            ),
            (
                "psi4",
                network.psi4(&f4, &actions),
                stock_block(&parameters, "dim.psi4", &global)?,
            ),
            (
                "phi4",
                network.phi4(&f4),
                stock_block(&parameters, "dim.phi4", &f4)?,
            ),
        ];
        for (name, found, wanted) in pairs {
            let found = found.unwrap();
            assert_close(name, &found, &wanted, 1e-6);
            let (mut found, wanted) = (
                Backward::of(&found.sqr()?.sum_all()?)?,
                wanted.sqr()?.sum_all()?.backward()?,
            );
            for (parameter, var) in parameters.iter() {
                match (found.remove(var)?, wanted.get(var)) {
                    (None, None) => {}
                    (Some(found), Some(wanted)) => assert_close(parameter, &found, wanted, 3e-6),
                    _ => panic!("{name}: only one way has a gradient for {parameter}"),
                }
            }
        }
    }
    Ok(())
}

#[test]
fn features_and_gradients_have_the_same_bits_for_any_number_of_threads() {
    for precision in Precision::ALL {
        the_same_bits_for_any_number_of_threads(precision, &small());
        the_same_bits_for_any_number_of_threads(precision, &small_with(DUELING));
        the_same_bits_for_any_number_of_threads(precision, &small_with(NOISY_DUELING));
    }
}

fn the_same_bits_for_any_number_of_threads(precision: Precision, config: &ModelConfig) {
    let streams = if config.head.dueling { 2 } else { 1 };
    let noise = HeadNoise::draw(config, &mut rng(3));
    let head = streams * if noise.is_some() { 4 } else { 2 };
    let parameters = with_biases(config);
    let kernels = Kernels::Fused(precision);
    let network = Network::with_kernels(config, &parameters, kernels).unwrap();
    let batch = frames(config, 61, &mut rng(2));
    let run = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new()
            .num_threads(threads)
            .build()
            .unwrap();
        pool.install(|| {
            let features = network.features(&batch).unwrap();
            let logits = network.noisy_logits(&features.f4, noise.as_ref()).unwrap();
            let phi3 = network.phi3(features.local().unwrap()).unwrap();
            let loss = (logits.sqr().unwrap().sum_all().unwrap()
                + phi3.sqr().unwrap().sum_all().unwrap())
            .unwrap();
            let mut grads = Backward::of(&loss).unwrap();
            let grads = parameters
                .iter()
                .filter_map(|(_, var)| grads.remove(var).unwrap().as_ref().map(bits))
                .collect::<Vec<_>>();
            (bits(&logits), grads)
        })
    };
    let one = run(1);
    assert_eq!(one.1.len(), 8 + head + 5, "torso, head, phi3");
    for threads in [2, 3] {
        assert!(run(threads) == one, "{threads} threads");
    }
}

/// Logits as the paper writes them, V + A - mean_a A after two products, and the same of one action a row.
#[test]
fn a_dueling_head_is_the_sum_of_its_streams() -> Result<()> {
    let config = small_with(DUELING);
    let parameters = with_biases(&config);
    let network = Network::new(&config, &parameters).unwrap();
    let f4 = crate::support::floats(&[6, config.hidden], &mut rng(4));
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
    let f4 = crate::support::floats(&[6, config.hidden], &mut rng(4));
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
fn a_network_follows_its_parameters() -> Result<()> {
    let config = small();
    let (parameters, batch) = (parameters(&config, 1), frames(&config, 3, &mut rng(3)));
    let network = Network::new(&config, &parameters).unwrap();
    let before = bits(&network.features(&batch).unwrap().f4);
    let bias = parameters.get("torso.fc.bias").unwrap();
    bias.set(&(bias.as_tensor() + 1.0)?)?;
    assert_ne!(before, bits(&network.features(&batch).unwrap().f4));
    Ok(())
}

#[test]
fn q_values_are_expectations_over_the_atoms() -> Result<()> {
    let config = small();
    let network = Network::new(&config, &parameters(&config, 1)).unwrap();
    let logits = crate::support::floats(&[3, 5, 11], &mut rng(4));
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
    let logits = crate::support::floats(&[30, 5, 11], &mut rng(4));
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

#[test]
fn heads_that_are_left_out_are_not_there() {
    let config = ModelConfig {
        dim: DimHeads {
            psi3: false,
            phi4: false,
            ..small().dim
        },
        ..small()
    };
    let parameters = parameters(&config, 1);
    assert!(
        parameters
            .iter()
            .all(|(name, _)| !name.starts_with("dim.psi3") && !name.starts_with("dim.phi4"))
    );
    let network = Network::new(&config, &parameters).unwrap();
    let features = network.features(&frames(&config, 2, &mut rng(5))).unwrap();
    let actions = Tensor::zeros(2, DType::I64, &Device::Cpu).unwrap();
    assert!(matches!(
        network.psi3(features.local().unwrap(), &actions),
        Err(ModelError::NoHead("psi3"))
    ));
    assert!(matches!(
        network.phi4(&features.f4),
        Err(ModelError::NoHead("phi4"))
    ));
    assert!(network.psi4(&features.f4, &actions).is_ok());

    let without_psi = ModelConfig {
        dim: DimHeads {
            psi3: false,
            psi4: false,
            ..small().dim
        },
        ..small()
    };
    assert!(
        without_psi
            .parameter_shapes()
            .iter()
            .all(|(name, _)| !name.starts_with("dim.action"))
    );
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
fn inputs_that_do_not_fit_are_errors() {
    let config = small();
    let network = Network::new(&config, &parameters(&config, 1)).unwrap();
    let batch = frames(&config, 2, &mut rng(6));
    let features = network.features(&batch).unwrap();
    assert!(
        network
            .features(&batch.to_dtype(DType::F32).unwrap())
            .is_err()
    );
    assert!(network.features(&batch.narrow(1, 0, 35).unwrap()).is_err());
    assert!(network.features(&batch.get(0).unwrap()).is_err());
    for wrong in [5i64, -1] {
        let actions = Tensor::new(&[0, wrong], &Device::Cpu).unwrap();
        assert!(matches!(
            network.psi4(&features.f4, &actions),
            Err(ModelError::Input(_))
        ));
    }
    let actions = Tensor::new(&[0i64, 1, 2], &Device::Cpu).unwrap();
    assert!(
        network.psi4(&features.f4, &actions).is_err(),
        "three actions for two rows"
    );
    assert!(
        network
            .logits(&features.f4.narrow(1, 0, 5).unwrap())
            .is_err()
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

#[test]
fn configurations_that_cannot_work_are_errors() {
    let fails = |change: fn(&mut ModelConfig)| {
        let mut config = small();
        change(&mut config);
        assert!(
            matches!(config.validate(), Err(ModelError::Config(_))),
            "{config:?}"
        );
        assert!(Parameters::init(&config, &mut rng(1), &Device::Cpu).is_err());
    };
    assert!(small().validate().is_ok());
    fails(|config| config.height = 0);
    fails(|config| config.height = 11);
    fails(|config| config.channels = usize::MAX);
    fails(|config| config.num_actions = 256);
    fails(|config| config.atoms = 1);
    fails(|config| config.v_max = config.v_min);
    fails(|config| config.v_min = f32::NAN);
    fails(|config| config.v_min = -3e38);
    fails(|config| config.v_max = 1e38);
    fails(|config| config.conv.clear());
    fails(|config| config.conv[1].kernel = 9);
    fails(|config| config.conv[0].stride = 0);
    fails(|config| config.conv[2].out = 0);
    fails(|config| (config.hidden, config.rkhs) = (65_536, 65_536));
}

#[test]
fn gradients_that_are_summed_in_place_are_candle_s() -> Result<()> {
    let config = small();
    let (parameters, batch) = (with_biases(&config), frames(&config, 9, &mut rng(4)));
    let network = Network::new(&config, &parameters).unwrap();
    // Every parameter twice, once through each half of the batch.
    let features = network.features(&batch).unwrap();
    let halves = [features.narrow(0, 4)?, features.narrow(4, 5)?];
    let losses = halves.map(|half| network.logits(&half.f4).unwrap().sqr()?.sum_all());
    let [first, second] = losses;
    let loss = (first? + second?)?;
    let (wanted, mut found) = (loss.backward()?, Backward::of(&loss)?);
    let mut compared = 0;
    for (name, var) in parameters.iter() {
        let gradient = found.remove(var)?;
        assert_eq!(gradient.is_some(), wanted.get(var).is_some(), "{name}");
        if let (Some(found), Some(wanted)) = (gradient, wanted.get(var)) {
            assert_close(name, &found, wanted, 1e-6);
            compared += 1;
        }
    }
    assert_eq!(compared, 8 + 2, "torso and head");
    Ok(())
}

#[test]
fn dot_products_and_their_gradients_are_candle_s() -> Result<()> {
    let rng = &mut rng(6);
    let (local, global) = ([5, 3, 7], [5, 7]);
    for (psi, phi) in [
        (&local[..], &local[..]),
        (&local, &global),
        (&global, &local),
        (&global, &global),
    ] {
        let (psi, phi) = (variable(psi, rng), variable(phi, rng));
        let ours = Kernels::FUSED.dot_products(&psi, &phi)?;
        let theirs = Kernels::Candle.dot_products(&psi, &phi)?;
        assert_close("dots", &ours, &theirs, 1e-6);
        let grad = crate::support::floats(ours.dims(), rng);
        let (found, wanted) = (
            (ours * &grad)?.sum_all()?.backward()?,
            (theirs * &grad)?.sum_all()?.backward()?,
        );
        for (name, var) in [("psi", &psi), ("phi", &phi)] {
            assert_close(
                name,
                found.get(var).unwrap(),
                wanted.get(var).unwrap(),
                1e-6,
            );
        }
    }
    let (psi, phi) = (variable(&[5, 3, 7], rng), variable(&[5, 2, 7], rng));
    assert!(Kernels::FUSED.dot_products(&psi, &phi).is_err());
    Ok(())
}
