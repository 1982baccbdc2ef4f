//! Compares the k in batches with the closed form of each rule.

use std::collections::HashMap;

use driml_protocol::{AffinityUpdate, Horizon};
use driml_replay_server::{Config, Replay, horizon::Affinity};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::{
    calls::{Actor, affinity, join, prioritised},
    history::{History, identity, spec},
    law::ChiSquare,
};

/// Returns the row-wise softmax of random scores of the given spread.
fn random_affinity(num_actions: u32, spread: f32, rng: &mut ChaCha8Rng) -> AffinityUpdate {
    let mut matrix = vec![];
    for _ in 0..num_actions {
        let row: Vec<f32> = (0..num_actions)
            .map(|_| (rng.random_range(-1.0..1.0f32) * spread).exp())
            .collect();
        let sum: f32 = row.iter().sum();
        matrix.extend(row.iter().map(|e| e / sum));
    }
    affinity(1, matrix)
}

/// Returns P(k = 1), .., P(k = H): (1 - A_i) prod_{j<i} A_j for i < H, and prod_{j<H} A_j.
fn nhg_law(update: &AffinityUpdate, actions: &[u8]) -> Vec<f64> {
    let n = update.matrix.len().isqrt();
    let at = |i: usize| usize::from(actions[i - 1]) * n + usize::from(actions[i]);
    let a = |i: usize| f64::from(update.matrix[at(i)]);
    let h = actions.len();
    let reached = |i: usize| (1..i).map(a).product::<f64>();
    let stops = |i: usize| if i < h { 1.0 - a(i) } else { 1.0 };
    (1..=h).map(|i| stops(i) * reached(i)).collect()
}

#[test]
fn an_older_or_broken_affinity_is_not_taken() {
    let mut current = Affinity::uniform(2);
    assert_eq!((current.version(), current.get(0, 1)), (0, 0.5));
    for (version, matrix, is_valid) in [
        (3, vec![0.0, 1.0, 0.25, 0.75], true),
        (2, vec![1.0, 0.0, 1.0, 0.0], true),
        (4, vec![0.5; 3], false),
        (4, vec![0.5, f32::NAN, 0.5, 0.5], false),
        (4, vec![0.5, 1.5, 0.5, 0.5], false),
    ] {
        let taken = current.update(&affinity(version, matrix));
        assert_eq!(taken.is_ok(), is_valid, "{taken:?}");
        assert_eq!((current.version(), current.get(1, 0)), (3, 0.25));
    }
}

/// Tests the k in batches for each anchor: by whatever rule the anchor was drawn, the walk must read the actions that follow it.
#[test]
fn the_k_served_follow_the_law() {
    let mut rng = ChaCha8Rng::seed_from_u64(15);
    for config in [Config::unlimited(150), prioritised(150, 0.5)] {
        let (mut replay, history) = filled(Horizon::Nhg { k_max: 5 }, &config, &mut rng);
        let equal = affinity(0, vec![0.2; 25]);
        check_ks(&mut replay, &history, |actions| nhg_law(&equal, actions));
        let update = random_affinity(5, 2.0, &mut rng);
        replay.set_affinity(&update).unwrap();
        check_ks(&mut replay, &history, |actions| nhg_law(&update, actions));
        let status = replay.status();
        assert_eq!(status.affinity_version, 1);
        assert_eq!(status.k_histogram.iter().sum::<u64>(), status.rows_sampled);
    }
    let (horizon, config) = (Horizon::Uniform { k_max: 5 }, Config::unlimited(150));
    let (mut replay, history) = filled(horizon, &config, &mut rng);
    let equal = |actions: &[u8]| vec![1.0 / actions.len() as f64; actions.len()];
    check_ks(&mut replay, &history, equal);
}

fn filled(horizon: Horizon, config: &Config, rng: &mut ChaCha8Rng) -> (Replay, History) {
    let spec = spec(3, 1, 2, horizon);
    let mut replay = Replay::new(&spec, config, 64).unwrap();
    join(&mut replay, 0, 1);
    let mut history = History::new(&spec, 150);
    let mut actor = Actor::new(0, 1);
    for _ in 0..20 {
        let chunk = history.next_chunk(actor.send(2, 5), 0, rng);
        replay.insert(&chunk);
    }
    (replay, history)
}

/// Checks the k of batches against `law`, which gives the probability of each k from the actions that follow an anchor.
fn check_ks(replay: &mut Replay, history: &History, law: impl Fn(&[u8]) -> Vec<f64>) {
    let mut counts: HashMap<_, Vec<u64>> = HashMap::new();
    for _ in 0..600 {
        let batch = replay.sample(64).unwrap();
        let states_t = batch.states_t();
        let states = states_t.chunks(history.spec.state_bytes());
        for (state, &k) in states.zip(batch.ks()) {
            let anchor = identity(&history.spec, state);
            let h = history.row(anchor.0, anchor.1).steps_left;
            assert_eq!(k > 0, h > 0);
            if h > 0 {
                counts.entry(anchor).or_insert_with(|| vec![0; h])[usize::from(k) - 1] += 1;
            }
        }
    }
    let mut chi = ChiSquare::default();
    for ((key, t), counts) in counts {
        let records = history.streams[&key][t..t + counts.len()].iter();
        let actions: Vec<u8> = records.map(|record| record.action).collect();
        chi.add(&counts, &law(&actions));
    }
    chi.check("the k served");
}
