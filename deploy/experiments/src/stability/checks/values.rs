//! Expected returns of logits over the atoms, and the action of largest value, as an actor chooses it.
//! Exploration is not here: it never looks at a value.

use candle_core::{Device, Tensor};
use driml_model::{
    ModelConfig, ModelError, Network, Parameters, PolicyNetwork, Precision, StoredAs,
};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::c51::shares;
use crate::stability::{
    edges::{SUPPORTS, Shown, exact_sum, finites, support, widened},
    property::{Cases, broken},
    small,
};

fn see(
    extreme: &str,
    cases: &mut Cases<'_>,
    support: (f32, f32),
    rows: &[Vec<f32>],
) -> anyhow::Result<()> {
    let atoms = rows[0].len();
    let config = small::config(atoms, 1, support);
    let rng = &mut ChaCha8Rng::seed_from_u64(0);
    let network = Network::new(&config, &Parameters::init(&config, rng, &Device::Cpu)?)?;
    let logits = Tensor::from_vec(rows.concat(), (rows.len(), 1, atoms), &Device::Cpu)?;
    let found = network.q_values(&logits)?.flatten_all()?.to_vec1::<f32>()?;
    let (low, high) = (f64::from(support.0), f64::from(support.1));
    for (found, logits) in found.iter().zip(rows) {
        let (shares, ..) = shares(&widened(logits));
        let places = shares.iter().enumerate();
        let place = exact_sum(places.map(|(i, p)| p * (i as f64 / (atoms - 1) as f64)));
        let expected = low + place * (high - low);
        let last_place = expected.abs().max(f32::MIN_POSITIVE.into()) / 2f64.powi(24);
        let error = (f64::from(*found) - expected).abs() - last_place;
        let error = match (support.0..=support.1).contains(found) {
            true => error.max(0.0) / (high - low),
            false => f64::NAN,
        };
        let input = format_args!("support {support:?}, logits {}", Shown(logits));
        cases.see(extreme, input, [error])?;
    }
    Ok(())
}

pub(crate) fn expected(cases: &mut Cases<'_>) -> anyhow::Result<()> {
    let listed = "2, 51, 1,001 atoms; supports from 0, far from 0 ([1e6, 1e6 + 1], [1000, 1001]), 1 ulp and 2e30 wide; logits equal, +-1e38, one -inf";
    for atoms in [2usize, 51, 1001] {
        let equal = [0.0, 1e38, -1e38, f32::MAX, 1e-45].map(|x| vec![x; atoms]);
        let ramps = [1e-40f32, 1.0, 30.0, 1e4, 1e38].iter().flat_map(|scale| {
            let place = |i: usize| (i * 37 % atoms) as f32 / atoms as f32;
            let ramp = (0..atoms).map(|i| place(i) * scale - scale / 2.0);
            let mut blocked: Vec<f32> = ramp.clone().collect();
            blocked[atoms / 2] = f32::NEG_INFINITY;
            [ramp.collect(), blocked]
        });
        let rows: Vec<_> = equal.into_iter().chain(ramps).collect();
        for support in SUPPORTS {
            see(listed, cases, support, &rows)?;
        }
    }
    for _ in cases.draws(0.05) {
        let rng = &mut cases.rng;
        let atoms = rng.random_range(2..120);
        let rows: Vec<_> = (0..20).map(|_| finites(atoms, rng)).collect();
        let support = support(rng);
        see("drawn", cases, support, &rows)?;
    }
    Ok(())
}

fn network(config: &ModelConfig, values: &[f32]) -> anyhow::Result<PolicyNetwork> {
    let parameters = small::parameters(config, values)?;
    let bytes = parameters.to_safetensors_as(StoredAs::F32, |_| true)?;
    Ok(PolicyNetwork::new(config, &bytes, Precision::F32)?)
}

pub(crate) fn greedy(cases: &mut Cases<'_>) -> anyhow::Result<()> {
    for number in cases.draws(0.05) {
        let num_actions = cases.rng.random_range(1..=255usize);
        // Two atoms on [-1, 1]; the parameters are four of the torso, then weights and biases of the head.
        let config = ModelConfig {
            num_actions,
            ..small::least()
        };
        let len = small::len(&config);
        let logits = match number {
            0 => vec![1e38; num_actions],
            1 => vec![-1e38; num_actions],
            2 => vec![0.0; num_actions],
            _ => finites(num_actions, &mut cases.rng),
        };
        // The logits of an action are biases alone: 0 and this one.
        let mut values = vec![0.0; len];
        let biases = values[len - 2 * num_actions..].chunks_exact_mut(2);
        biases
            .zip(&logits)
            .for_each(|(biases, &logit)| biases[1] = logit);
        let rows = cases.rng.random_range(1..70usize);
        let mut actions = vec![0u8; rows];
        network(&config, &values)?.greedy_actions(&vec![255; rows], &mut actions)?;
        // -1 + 2 / (1 + exp(-logit)).
        let value = |logit: f32| (f64::from(logit) / 2.0).tanh();
        let most = logits
            .iter()
            .copied()
            .map(value)
            .fold(f64::NEG_INFINITY, f64::max);
        for action in actions.iter().map(|&action| usize::from(action)) {
            let below = most - value(logits[action]);
            let is_lowest = !logits[..action].contains(&logits[action]);
            let extreme =
                "drawn logits to 3.4e38, among them equal ones; all 1e38, all -1e38, all 0";
            let input = format_args!("action {action}, logits {}", Shown(&logits));
            cases.see(extreme, input, [below, broken(is_lowest)])?;
        }

        // Twice the pixel's share of 255 times a weight of 3.4e38, where the pixel is not black.
        let mut values = vec![0.0; len];
        (values[0], values[2]) = (1.0, 2.0);
        values[4 + cases.rng.random_range(0..2 * num_actions)] = f32::MAX;
        let mut pixel = || if cases.rng.random_bool(0.05) { 255 } else { 0 };
        let frames: Vec<u8> = (0..rows).map(|_| pixel()).collect();
        let found = network(&config, &values)?.greedy_actions(&frames, &mut actions);
        let first = frames.iter().position(|&pixel| pixel != 0);
        let right = match (&found, first) {
            (Ok(()), None) => true,
            (Err(ModelError::NotFinite { row }), Some(first)) => *row == first,
            _ => false,
        };
        let extreme = "weights that take a value beyond 3.4e38 in some rows of a batch";
        let input = format_args!("{rows} rows, the first {first:?}: {found:?}");
        cases.see(extreme, input, [None, None, Some(broken(right))])?;
    }
    Ok(())
}
