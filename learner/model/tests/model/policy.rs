//! The policy compared with the network, with which it must agree.
//! `weights` tests the loading of broken weights.

use driml_model::{HeadConfig, HeadNoise, Kernels, Network, PolicyNetwork, Precision, TorsoName};

use crate::support::{
    bytes, configs, frames, parameters, policy, pool, q_values, residual, rng, small, small_with,
    values,
};

#[test]
fn it_agrees_with_the_network_for_any_batch_and_number_of_threads() {
    for config in configs() {
        let parameters = parameters(&config, 3);
        let network = Network::new(&config, &parameters, Kernels::FUSED).unwrap();
        let mut policy = policy(&config, &parameters, Precision::F32);
        for batch in [1, 2, 5, 33, 70] {
            let states = bytes(batch * config.frame_len(), &mut rng(batch as u64));
            let tensor = frames(&config, batch, &mut rng(batch as u64));
            let noise = HeadNoise::draw(&config, &mut rng(7 + batch as u64));
            policy.set_noise(noise.as_ref());
            let f4 = network.features(&tensor).unwrap().f4;
            let logits = network.logits(&f4, noise.as_ref()).unwrap();
            let wanted = values(&network.q_values(&logits).unwrap());
            for threads in [1, 2, 3] {
                let mut values = vec![0.0; batch * 5];
                let mut actions = vec![0; batch];
                pool(threads).install(|| {
                    policy.q_values(&states, &mut values).unwrap();
                    policy.greedy_actions(&states, &mut actions).unwrap();
                });
                for (value, wanted) in values.iter().zip(&wanted) {
                    let error = (f64::from(*value) - wanted).abs();
                    assert!(error < 1e-5, "batch {batch}, {threads} threads: {error}");
                }
                for (action, values) in actions.iter().zip(values.chunks(5)) {
                    let chosen = values[usize::from(*action)];
                    assert!(values.iter().all(|&value| value <= chosen));
                }
            }
        }
    }
}

/// An actor skips states in which chance decides. The values of other states must not depend on that.
#[test]
fn a_state_has_the_same_values_in_any_company() {
    // The last layer's maps have an even number of scalars, and then an odd number.
    let mut odd = small();
    (odd.conv[2].out, odd.conv[2].kernel, odd.conv[2].stride) = (7, 3, 2);
    for config in [small(), odd, residual(TorsoName::Impala)] {
        let parameters = parameters(&config, 3);
        let frames = bytes(70 * config.frame_len(), &mut rng(1));
        for precision in Precision::ALL {
            let mut policy = policy(&config, &parameters, precision);
            let mut bits = |states: &[u8]| -> Vec<u32> {
                let values = q_values(&mut policy, &config, states);
                values.iter().map(|it| it.to_bits()).collect()
            };
            let all = bits(&frames);
            for step in [2, 3, 7, 69] {
                let some = (0..70usize).step_by(step);
                let states = some.clone().map(|at| at * config.frame_len());
                let states = states.flat_map(|from| &frames[from..][..config.frame_len()]);
                let values = bits(&states.copied().collect::<Vec<_>>());
                for (at, values) in some.zip(values.chunks(5)) {
                    assert_eq!(values, &all[at * 5..][..5], "{precision}, {at}");
                }
            }
        }
    }
}

#[test]
fn new_weights_take_effect() {
    let config = small();
    let file = |seed: u64| parameters(&config, seed).to_safetensors(|_| true).unwrap();
    let frames = bytes(4 * config.frame_len(), &mut rng(1));
    let mut policy = policy(&config, &parameters(&config, 1), Precision::F32);
    let first = q_values(&mut policy, &config, &frames);
    policy.load(&file(2)).unwrap();
    assert_ne!(q_values(&mut policy, &config, &frames), first);
    policy.load(&file(1)).unwrap();
    assert_eq!(q_values(&mut policy, &config, &frames), first);
}

/// The property table of `driml experiment stability` covers values that are not finite.
#[test]
fn wrong_lengths_are_errors() {
    let config = small().without_dim();
    let mut policy = policy(&config, &parameters(&config, 1), Precision::F32);
    let frames = bytes(2 * config.frame_len(), &mut rng(1));
    assert!(policy.greedy_actions(&frames, &mut []).is_err());
    assert!(policy.greedy_actions(&[], &mut []).is_ok(), "nothing to do");
    assert!(policy.greedy_actions(&frames, &mut [0; 3]).is_err());
    assert!(policy.greedy_actions(&frames[1..], &mut [0; 2]).is_err());
    assert!(policy.q_values(&frames, &mut [0.0; 9]).is_err());
}

/// New weights have no noise until noise is drawn. Evaluation draws none and thus acts by the means.
#[test]
fn noise_is_drawn_when_it_is_asked_for() {
    let config = small_with(HeadConfig::RAINBOW);
    let drawn = parameters(&config, 3);
    let mut noisy = policy(&config, &drawn, Precision::F32);
    let frames = bytes(config.frame_len(), &mut rng(1));
    let values = |policy: &mut PolicyNetwork| q_values(policy, &config, &frames);
    let mean = values(&mut noisy);
    let generator = &mut rng(2);
    noisy.draw_noise(generator);
    let first = values(&mut noisy);
    noisy.draw_noise(generator);
    let second = values(&mut noisy);
    assert!(first != mean && second != mean && first != second);
    noisy.draw_noise(&mut rng(2));
    assert_eq!(values(&mut noisy), first);
    noisy
        .load(&drawn.to_safetensors(|_| true).unwrap())
        .unwrap();
    assert_eq!(values(&mut noisy), mean);
    // A head without noisy layers draws nothing.
    let plain = small();
    let mut plain = policy(&plain, &parameters(&plain, 3), Precision::F32);
    let mean = values(&mut plain);
    let generator = &mut rng(2);
    plain.draw_noise(generator);
    assert_eq!(values(&mut plain), mean);
    assert_eq!(*generator, rng(2));
}
