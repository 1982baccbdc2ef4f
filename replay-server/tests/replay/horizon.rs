//! The k that are drawn, against the closed form of each rule, alone and as served.
//! It does not test what the rows hold.

use std::collections::HashMap;

use driml_protocol::{AffinityUpdate, ChunkHeader, Horizon};
use driml_replay_server::{
    Replay,
    horizon::{Affinity, draw_k, nhg, uniform},
};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::{
    calls::join,
    history::{History, identity, spec, unlimited},
    law::ChiSquare,
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
    AffinityUpdate {
        learner: 1,
        version: 1,
        num_actions,
        matrix,
    }
}

fn affinity(update: &AffinityUpdate) -> Affinity {
    let mut affinity = Affinity::uniform(update.num_actions);
    affinity.update(update).unwrap();
    affinity
}

/// P(k = 1), .., P(k = H): (1 - A_i) prod_{j<i} A_j for i < H, and prod_{j<H} A_j.
fn nhg_law(update: &AffinityUpdate, actions: &[u8]) -> Vec<f64> {
    let n = update.num_actions as usize;
    let a = |i: usize| {
        f64::from(update.matrix[usize::from(actions[i - 1]) * n + usize::from(actions[i])])
    };
    let h = actions.len();
    let reached = |i: usize| (1..i).map(a).product::<f64>();
    (1..=h)
        .map(|i| {
            if i < h {
                (1.0 - a(i)) * reached(i)
            } else {
                reached(h)
            }
        })
        .collect()
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
        let affinity = affinity(&update);
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
    for (k_max, steps_left) in [(5, 5), (5, 9), (5, 3), (2, 7), (9, 2)] {
        let h = k_max.min(steps_left) as usize;
        let counts = count(h, 5_000, || uniform::draw_k(k_max, steps_left, &mut rng));
        chi.add(&counts, &vec![1.0 / h as f64; h]);
    }
    chi.check("uniform");
    assert_eq!(uniform::draw_k(5, 1, &mut rng), 1, "the end of the episode");
}

/// Action 1 always follows action 0, and never action 1: A = 1 goes on to the end, A = 0 stops at once.
#[test]
fn certain_affinities_leave_no_choice() {
    let certain = AffinityUpdate {
        learner: 1,
        version: 1,
        num_actions: 2,
        matrix: vec![0.0, 1.0, 1.0, 0.0],
    };
    let affinity = affinity(&certain);
    let rng = &mut ChaCha8Rng::seed_from_u64(13);
    for _ in 0..200 {
        assert_eq!(nhg::draw_k(&affinity, &[0, 0, 1, 0, 1], rng), 1, "A_1 = 0");
        assert_eq!(
            nhg::draw_k(&affinity, &[0, 1, 0, 1, 0], rng),
            5,
            "A_i = 1 up to H"
        );
        assert_eq!(nhg::draw_k(&affinity, &[0, 1, 0, 0, 1], rng), 3, "A_3 = 0");
        assert_eq!(nhg::draw_k(&affinity, &[0], rng), 1, "one step left");
    }
}

#[test]
fn every_rule_stays_within_k_max_and_the_episode() {
    let affinity = affinity(&AffinityUpdate {
        learner: 1,
        version: 1,
        num_actions: 1,
        matrix: vec![1.0],
    });
    let rng = &mut ChaCha8Rng::seed_from_u64(14);
    assert_eq!(draw_k(Horizon::None, &affinity, &[0; 3], rng), None);
    assert_eq!(
        draw_k(Horizon::Fixed { k: 4 }, &affinity, &[0; 9], rng),
        Some(4)
    );
    assert_eq!(
        draw_k(Horizon::Fixed { k: 4 }, &affinity, &[0; 2], rng),
        Some(2)
    );
    for (steps, furthest) in [(9, 4), (4, 4), (2, 2)] {
        let all = Horizon::All { k_max: 4 };
        assert_eq!(draw_k(all, &affinity, &vec![0; steps], rng), Some(furthest));
    }
    assert_eq!(
        draw_k(Horizon::Nhg { k_max: 4 }, &affinity, &[0; 9], rng),
        Some(4)
    );
    assert_eq!(
        draw_k(Horizon::Nhg { k_max: 4 }, &affinity, &[0; 2], rng),
        Some(2)
    );
    for _ in 0..100 {
        assert!(draw_k(Horizon::Uniform { k_max: 4 }, &affinity, &[0; 9], rng).unwrap() <= 4);
    }
}

#[test]
fn an_older_or_broken_affinity_is_not_taken() {
    let mut affinity = Affinity::uniform(2);
    assert_eq!((affinity.version(), affinity.get(0, 1)), (0, 0.5));
    let update = |version, matrix| AffinityUpdate {
        learner: 1,
        version,
        num_actions: 2,
        matrix,
    };
    affinity
        .update(&update(3, vec![0.0, 1.0, 0.25, 0.75]))
        .unwrap();
    affinity
        .update(&update(2, vec![1.0, 0.0, 1.0, 0.0]))
        .unwrap();
    assert_eq!((affinity.version(), affinity.get(1, 0)), (3, 0.25));
    assert!(affinity.update(&update(4, vec![0.5; 3])).is_err());
    assert!(
        affinity
            .update(&update(4, vec![0.5, f32::NAN, 0.5, 0.5]))
            .is_err()
    );
    assert!(
        affinity
            .update(&update(4, vec![0.5, 1.5, 0.5, 0.5]))
            .is_err()
    );
    assert_eq!((affinity.version(), affinity.get(1, 0)), (3, 0.25));
}

/// k as it leaves the server, anchor by anchor: the walk must read the actions that follow that anchor.
#[test]
fn the_k_served_follow_the_law() {
    let mut rng = ChaCha8Rng::seed_from_u64(15);
    let spec = spec(3, 1, 2, Horizon::Nhg { k_max: 5 });
    let update = random_affinity(spec.num_actions, 2.0, &mut rng);
    let mut replay = Replay::new(&spec, &unlimited(150), 64).unwrap();
    join(&mut replay, 0, 1);
    let mut history = History::new(&spec, 150);
    for sequence in 0..20 {
        let header = ChunkHeader {
            actor: 0,
            incarnation: 1,
            sequence,
            first_transition: sequence * 10,
            weights_version: 0,
            leaving: false,
            streams: 2,
            steps: 5,
            frame_bytes: spec.frame_bytes() as u32,
        };
        replay.insert(&history.next_chunk(header, 0, &mut rng));
    }
    for (what, update) in [
        ("before the first affinity", None),
        ("after it", Some(update)),
    ] {
        let law = match update {
            Some(update) => {
                replay.set_affinity(&update).unwrap();
                update
            }
            None => AffinityUpdate {
                learner: 1,
                version: 0,
                num_actions: 5,
                matrix: vec![0.2; 25],
            },
        };
        let mut counts: HashMap<_, Vec<u64>> = HashMap::new();
        for _ in 0..600 {
            let batch = replay.sample(64).unwrap();
            for (row, state) in batch.states_t().chunks(spec.state_bytes()).enumerate() {
                let (key, t) = identity(&spec, state);
                let h = history.row(key, t).steps_left;
                assert_eq!(batch.ks()[row] > 0, h > 0);
                if h > 0 {
                    counts.entry((key, t)).or_insert_with(|| vec![0; h])
                        [usize::from(batch.ks()[row]) - 1] += 1;
                }
            }
        }
        let mut chi = ChiSquare::default();
        for ((key, t), counts) in counts {
            let actions: Vec<u8> = history.streams[&key][t..t + counts.len()]
                .iter()
                .map(|record| record.action)
                .collect();
            chi.add(&counts, &nhg_law(&law, &actions));
        }
        chi.check(what);
    }
    assert_eq!(replay.status().affinity_version, 1);
    assert_eq!(
        replay.status().k_histogram.iter().sum::<u64>(),
        replay.status().rows_sampled
    );
}
