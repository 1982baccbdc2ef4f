//! The expected return of logits over the atoms, and the greedy action as an actor chooses it.
//! Exploration is not checked because it does not depend on values.

use candle_core::{Device, Tensor};
use driml_model::{
    EXPECTED_RETURN_ERROR, Kernels, ModelConfig, ModelError, Network, PolicyNetwork, Precision,
};

use crate::{small, stability::property::*};

const LOGITS: &str = "2, 51, 1,001 atoms; supports from 0, far from 0 ([1e6, 1e6 + 1], [1000, 1001]), 1 ulp and 2e30 wide; logits equal, +-1e38, some -inf";
const EQUAL: &str = "logits equal, ramps, +-3.4e38, subnormal, one unlike the rest";
const TOO_LARGE: &str = "weights that take a value beyond 3.4e38 in some rows of a batch";

pub(super) fn properties() -> Vec<Property> {
    let values = "the expected return; logits finite, or some of them -inf; a support within 1e30";
    vec![
        Property::new("Q-value", values)
            // An error in the last place of the value is not counted. A value outside the support breaks the promise.
            .promise("a value, as a share of the width", EXPECTED_RETURN_ERROR)
            .check(LOGITS, Listed, expected_return)
            .check("drawn, some logits -inf", Drawn(1.0), expected_return),
        Property::new("greedy action", "weights finite; 1 to 255 actions")
            // The values of both actions may round to the same f32.
            .promise("how far its value is below the largest", F32_STEP)
            .promise("actions of which a lower one has the same logits", 0.0)
            .promise("rows beyond the finite numbers not refused by number", 0.0)
            .check(EQUAL, Listed, greedy)
            .check("drawn logits, some of them equal", Drawn(0.05), greedy)
            .check(TOO_LARGE, Drawn(0.05), too_large),
    ]
}

fn expected_return(cases: &mut Cases<'_>) -> anyhow::Result<()> {
    let atoms = cases.listed_or(&[2usize, 51, 1001], |rng| rng.random_range(2..120));
    let support = cases.listed_or(&SUPPORTS, draw_support);
    let mut logits = cases.listed_or(&extremes(atoms), |rng| draw_finites(atoms, rng));
    if cases.one_of(&[false, true]) {
        let kept = cases.rng.random_range(0..atoms);
        for (atom, logit) in logits.iter_mut().enumerate() {
            if atom != kept && cases.rng.random_bool(0.2) {
                *logit = f32::NEG_INFINITY;
            }
        }
    }
    let config = small::config(atoms, 1, support);
    let network = Network::new(&config, &small::parameters(&config, &[])?, Kernels::FUSED)?;
    let batch = Tensor::from_slice(&logits, (1, 1, atoms), &Device::Cpu)?;
    let found = network.q_values(&batch)?.flatten_all()?.to_vec1::<f32>()?[0];
    let (low, high) = (f64::from(support.0), f64::from(support.1));
    let (shares, ..) = softmax_f64(&to_f64(&logits));
    let places = shares.iter().enumerate();
    let place = exact_sum(places.map(|(i, p)| p * (i as f64 / (atoms - 1) as f64)));
    let expected = low + place * (high - low);
    let last_place = expected.abs().max(MIN_NORMAL) / 2f64.powi(24);
    let error = (f64::from(found) - expected).abs() - last_place;
    let is_within = (support.0..=support.1).contains(&found);
    let error = nan_unless(is_within, error.max(0.0) / (high - low));
    let input = format_args!("support {support:?}, logits {}", Preview(&logits));
    cases.record_errors(input, [error])
}

/// Creates a policy with two atoms on [-1, 1] for each action. `set` fills the parameters: four of the torso, then head weights, biases.
fn new_policy(num_actions: usize, set: impl FnOnce(&mut [f32])) -> anyhow::Result<PolicyNetwork> {
    let config = ModelConfig {
        num_actions,
        ..small::minimal_config()
    };
    let mut values = vec![0.0; small::scalar_count(&config)];
    set(&mut values);
    let bytes = small::parameters(&config, &values)?.to_safetensors(|_| true)?;
    Ok(PolicyNetwork::new(&config, &bytes, Precision::F32)?)
}

fn greedy(cases: &mut Cases<'_>) -> anyhow::Result<()> {
    let num_actions = cases.rng.random_range(1..=255usize);
    let logits = cases.listed_or(&extremes(num_actions), |rng| draw_finites(num_actions, rng));
    // The weights are 0, so the two logits of an action are its biases: 0 and the listed logit.
    let mut policy = new_policy(num_actions, |values| {
        let first = values.len() - 2 * num_actions;
        let biases = values[first..].chunks_exact_mut(2).zip(&logits);
        biases.for_each(|(biases, &logit)| biases[1] = logit);
    })?;
    let rows = cases.rng.random_range(1..70usize);
    let mut actions = vec![0u8; rows];
    policy.greedy_actions(&vec![255; rows], &mut actions)?;
    // The value is -1 + 2 / (1 + exp(-logit)).
    let value = |logit: f32| (f64::from(logit) / 2.0).tanh();
    let values = logits.iter().map(|&logit| value(logit));
    let value_max = values.fold(f64::NEG_INFINITY, f64::max);
    for action in actions.iter().map(|&action| usize::from(action)) {
        let is_lowest = !logits[..action].contains(&logits[action]);
        let input = format_args!("action {action}, logits {}", Preview(&logits));
        let below = value_max - value(logits[action]);
        cases.record_errors(input, [below, f64::from(!is_lowest)])?;
    }
    Ok(())
}

fn too_large(cases: &mut Cases<'_>) -> anyhow::Result<()> {
    let rng = &mut cases.rng;
    let num_actions = rng.random_range(1..=255usize);
    // If the pixel is not black, a logit is 2 (pixel / 255) 3.4e38, which overflows.
    let mut policy = new_policy(num_actions, |values| {
        (values[0], values[2]) = (1.0, 2.0);
        values[4 + rng.random_range(0..2 * num_actions)] = f32::MAX;
    })?;
    let rows = rng.random_range(1..70usize);
    let mut pixel = || if rng.random_bool(0.05) { 255 } else { 0 };
    let frames: Vec<u8> = (0..rows).map(|_| pixel()).collect();
    let found = policy.greedy_actions(&frames, &mut vec![0; rows]);
    let first = frames.iter().position(|&pixel| pixel != 0);
    let is_right = match (&found, first) {
        (Ok(()), None) => true,
        (Err(ModelError::NotFinite { row }), Some(first)) => *row == first,
        _ => false,
    };
    let input = format_args!("{rows} rows, the first {first:?}: {found:?}");
    cases.record_errors(input, [None, None, Some(f64::from(!is_right))])
}
