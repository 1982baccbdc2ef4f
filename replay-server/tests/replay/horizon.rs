//! The k that are drawn, against the closed form of each rule, alone and as served.

use std::collections::HashMap;

use driml_protocol::{AffinityUpdate, ChunkHeader, Horizon};
use driml_replay_server::{
    Replay,
    horizon::{Affinity, draw_k, nhg},
};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::{
    calls::{affinity, header, join},
    history::{History, identity, spec, unlimited},
    law::ChiSquare,
    rows::prioritised,
};

/// Row-wise softmax of random scores of the given spread.
fn random_affinity(num_actions: u32, spread: f32, rng: &mut ChaCha8Rng) -> AffinityUpdate {
    let mut matrix = vec![];
    for _ in 0..num_actions {
        let row: Vec<f32> = (0..num_actions)
            .map(|_| (rng.random_range(-1.0..1.0f32) * spread).exp())
            .collect();
        let sum: f32 = row.iter().sum();
        matrix.extend(row.iter().map(|e| e / sum));
    }
    affinity(1, num_actions, matrix)
}

fn taken(update: &AffinityUpdate) -> Affinity {
    let mut affinity = Affinity::uniform(update.num_actions);
    affinity.update(update).unwrap();
    affinity
}

/// P(k = 1), .., P(k = H): (1 - A_i) prod_{j<i} A_j for i < H, and prod_{j<H} A_j.
fn nhg_law(update: &AffinityUpdate, actions: &[u8]) -> Vec<f64> {
    let n = update.num_actions as usize;
    let at = |i: usize| usize::from(actions[i - 1]) * n + usize::from(actions[i]);
    let a = |i: usize| f64::from(update.matrix[at(i)]);
    let h = actions.len();
    let reached = |i: usize| (1..i).map(a).product::<f64>();
    let stops = |i: usize| if i < h { 1.0 - a(i) } else { 1.0 };
    (1..=h).map(|i| stops(i) * reached(i)).collect()
}

fn count(h: usize, draws: u32, mut draw: impl FnMut() -> u32) -> Vec<u64> {
    let mut counts = vec![0; h];
    for _ in 0..draws {
        counts[draw() as usize - 1] += 1;
    }
    counts
}

#[test]
fn nhg_follows_its_law() {
    let mut rng = ChaCha8Rng::seed_from_u64(11);
    let mut chi = ChiSquare::default();
    for _ in 0..100 {
        let num_actions = rng.random_range(1..16);
        let spread = rng.random_range(0.0..6.0);
        let update = random_affinity(num_actions, spread, &mut rng);
        let affinity = taken(&update);
        let h = rng.random_range(1..10);
        let actions: Vec<u8> = (0..h)
            .map(|_| rng.random_range(0..num_actions as u8))
            .collect();
        let counts = count(h, 5_000, || nhg::draw_k(&affinity, &actions, &mut rng));
        chi.add(&counts, &nhg_law(&update, &actions));
    }
    chi.check("nhg");
}

#[test]
fn uniform_follows_its_law() {
    let mut rng = ChaCha8Rng::seed_from_u64(12);
    let mut chi = ChiSquare::default();
    let affinity = Affinity::uniform(1);
    let mut draw = |k_max, steps_left| {
        let horizon = Horizon::Uniform { k_max };
        draw_k(horizon, &affinity, &vec![0; steps_left], &mut rng).unwrap()
    };
    for (k_max, steps_left) in [(5, 5), (5, 9), (5, 3), (2, 7), (9, 2)] {
        let h = steps_left.min(k_max as usize);
        let counts = count(h, 5_000, || draw(k_max, steps_left));
        chi.add(&counts, &vec![1.0 / h as f64; h]);
    }
    chi.check("uniform");
    assert_eq!(draw(5, 1), 1, "the end of the episode");
}

/// Action 1 always follows action 0, and never action 1: A = 1 walks to the end, A = 0 stops at once.
#[test]
fn certain_affinities_leave_no_choice() {
    let affinity = taken(&affinity(1, 2, vec![0.0, 1.0, 1.0, 0.0]));
    let rng = &mut ChaCha8Rng::seed_from_u64(13);
    for _ in 0..200 {
        let mut k = |actions: &[u8]| nhg::draw_k(&affinity, actions, rng);
        assert_eq!(k(&[0, 0, 1, 0, 1]), 1, "A_1 = 0");
        assert_eq!(k(&[0, 1, 0, 1, 0]), 5, "A_i = 1 up to H");
        assert_eq!(k(&[0, 1, 0, 0, 1]), 3, "A_3 = 0");
        assert_eq!(k(&[0]), 1, "one step left");
    }
}

#[test]
fn every_rule_stays_within_k_max_and_the_episode() {
    let affinity = taken(&affinity(1, 1, vec![1.0]));
    let rng = &mut ChaCha8Rng::seed_from_u64(14);
    let nhg = Horizon::Nhg { k_max: 4 };
    let mut cases = vec![
        (Horizon::None, 3, None),
        (nhg, 9, Some(4)),
        (nhg, 2, Some(2)),
    ];
    for (k_max, steps_left, expected) in [(1, 1, 1), (1, 7, 1), (4, 9, 4), (4, 4, 4), (4, 1, 1)] {
        let rules = [Horizon::Fixed { k: k_max }, Horizon::All { k_max }];
        cases.extend(rules.map(|it| (it, steps_left, Some(expected))));
    }
    for (horizon, steps_left, expected) in cases {
        let k = draw_k(horizon, &affinity, &vec![0; steps_left], rng);
        assert_eq!(k, expected, "{horizon:?}, {steps_left} left");
    }
    for _ in 0..100 {
        assert!(draw_k(Horizon::Uniform { k_max: 4 }, &affinity, &[0; 9], rng).unwrap() <= 4);
    }
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
        let taken = current.update(&affinity(version, 2, matrix));
        assert_eq!(taken.is_ok(), is_valid, "{taken:?}");
        assert_eq!((current.version(), current.get(1, 0)), (3, 0.25));
    }
}

/// k as it leaves the server, anchor by anchor: the walk must read the actions that follow that anchor, by whatever rule it was drawn.
#[test]
fn the_k_served_follow_the_law() {
    for config in [unlimited(150), prioritised(150, 0.5)] {
        let mut rng = ChaCha8Rng::seed_from_u64(15);
        let spec = spec(3, 1, 2, Horizon::Nhg { k_max: 5 });
        let update = random_affinity(spec.num_actions, 2.0, &mut rng);
        let mut replay = Replay::new(&spec, &config, 64).unwrap();
        join(&mut replay, 0, 1);
        let mut history = History::new(&spec, 150);
        for sequence in 0..20 {
            let header = ChunkHeader {
                steps: 5,
                ..header(0, 1, sequence, sequence * 10)
            };
            replay.insert(&history.next_chunk(header, 0, &mut rng));
        }
        check_ks(&mut replay, &history, &affinity(0, 5, vec![0.2; 25]));
        replay.set_affinity(&update).unwrap();
        check_ks(&mut replay, &history, &update);
        let status = replay.status();
        assert_eq!(status.affinity_version, 1);
        assert_eq!(status.k_histogram.iter().sum::<u64>(), status.rows_sampled);
    }
}

fn check_ks(replay: &mut Replay, history: &History, law: &AffinityUpdate) {
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
        chi.add(&counts, &nhg_law(law, &actions));
    }
    chi.check("the k served");
}
