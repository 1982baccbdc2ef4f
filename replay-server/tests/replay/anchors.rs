//! Every valid anchor is equally likely, where they are many and where they are few.
//! It does not check what the rows hold.

use std::collections::HashMap;

use driml_protocol::{ChunkHeader, Horizon, InsertReply, Waiting};
use driml_replay_server::{Config, Replay, Unready};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use crate::{
    calls::{header, join, stored, wait},
    history::{History, identity, spec, unlimited},
    law::ChiSquare,
};

struct Setup {
    replay: Replay,
    history: History,
    rng: ChaCha8Rng,
}

impl Setup {
    fn new(config: &Config, frame_stack: u32) -> Self {
        let spec = spec(3, frame_stack, 4, Horizon::Uniform { k_max: 3 });
        let mut replay = Replay::new(&spec, config, 64).unwrap();
        for actor in 0..4 {
            join(&mut replay, actor, 1);
        }
        Self {
            replay,
            history: History::new(&spec, config.capacity_transitions),
            rng: ChaCha8Rng::seed_from_u64(3),
        }
    }

    fn insert(&mut self, actor: u32, sequence: u64, streams: u32, steps: u32) -> InsertReply {
        let chunk = self.history.next_chunk(
            ChunkHeader {
                streams,
                steps,
                ..header(actor, 1, sequence, sequence * u64::from(streams * steps))
            },
            0,
            &mut self.rng,
        );
        self.replay.insert(&chunk)
    }

    fn check_uniform(&mut self, what: &str) {
        let anchors = self.history.valid_anchors();
        let mut counts: HashMap<_, u64> = anchors.iter().map(|&anchor| (anchor, 0)).collect();
        let bytes = self.history.spec.state_bytes();
        for _ in 0..anchors.len() * 2 {
            let batch = self.replay.sample(64).unwrap();
            for state in batch.states_t().chunks(bytes) {
                *counts
                    .get_mut(&identity(&self.history.spec, state))
                    .unwrap() += 1;
            }
        }
        let counts: Vec<u64> = counts.into_values().collect();
        let mut chi = ChiSquare::default();
        chi.add(&counts, &vec![1.0 / counts.len() as f64; counts.len()]);
        chi.check(what);
    }
}

#[test]
fn many_anchors_are_equally_likely() {
    for frame_stack in [1, 4] {
        let mut setup = Setup::new(&unlimited(200), frame_stack);
        for sequence in 0..30 {
            setup.insert(0, sequence, 2, 5);
            setup.insert(1, sequence, 1, 3);
        }
        assert!(setup.history.valid_anchors().len() > 100);
        setup.check_uniform("anchors by rejection");
    }
}

#[test]
fn few_anchors_are_equally_likely() {
    let mut setup = Setup::new(&unlimited(2000), 1);
    setup.history.ends = false;
    setup.insert(0, 0, 1, 20);
    // Streams of one step each: none of these can be an anchor.
    setup.insert(1, 0, 900, 1);
    setup.insert(2, 0, 900, 1);
    let anchors = setup.history.valid_anchors().len();
    assert_eq!(
        (anchors, setup.history.inserted),
        (16, 1820),
        "half of all first tries fail"
    );
    setup.check_uniform("anchors by listing");
}

/// Nothing ends and no stream is long enough: both sides would wait for each other, were actors not let on.
#[test]
fn without_any_anchor_actors_go_on_and_the_end_has_a_reason() {
    let config = Config {
        replay_ratio: 64.0,
        slack_transitions: 1,
        transitions_max: Some(60),
        ..unlimited(10_000)
    };
    let spec = spec(3, 1, 4, Horizon::None);
    let mut replay = Replay::new(&spec, &config, 64).unwrap();
    join(&mut replay, 0, 1);
    let mut header = ChunkHeader {
        streams: 20,
        steps: 1,
        ..header(0, 1, 0, 0)
    };
    for total in [20, 40, 60] {
        let chunk = driml_protocol::Chunk::zeroed(header);
        assert_eq!(replay.insert(&chunk), stored(total));
        header.sequence += 1;
        header.first_transition += 20;
        let chunk = driml_protocol::Chunk::zeroed(header);
        if total < 60 {
            assert_eq!(replay.insert(&chunk), wait(total));
            let hungry = Waiting::LearnerWaitsForActors;
            assert_eq!(replay.sample(64), Err(Unready::Wait(hungry)));
            assert_eq!(replay.waiting(), hungry);
        } else {
            let reply = replay.insert(&chunk);
            assert!(matches!(
                reply,
                InsertReply::Finished { inserted_total: 60 }
            ));
            let answer = replay.sample(64);
            assert!(matches!(answer, Err(Unready::Refused { .. })), "{answer:?}");
        }
        replay.check_valid();
    }
}
