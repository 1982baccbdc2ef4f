//! Every transition is stored once and every batch counted once, over a network that delays, repeats and drops messages and
//! their answers.
//! It does not look at rows.

use driml_protocol::{
    AffinityUpdate, Chunk, ChunkHeader, End, Goodbye, Horizon, InsertReply, Planes, RequestId,
    RunSpec, Waiting,
};
use driml_replay_server::{ACTORS_MAX, Replay, STREAMS_MAX, Unready};
use proptest::prelude::*;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::history::{spec, unlimited};

pub(crate) fn small_spec() -> RunSpec {
    spec(3, 1, 1, Horizon::None)
}

pub(crate) fn header(actor: u32, epoch: u64, sequence: u64, first_transition: u64) -> ChunkHeader {
    ChunkHeader {
        actor,
        epoch,
        sequence,
        first_transition,
        weights_version: 0,
        leaving: false,
        streams: 2,
        steps: 3,
        frame_bytes: small_spec().frame_bytes() as u32,
    }
}

pub(crate) fn insert(replay: &mut Replay, header: ChunkHeader) -> InsertReply {
    let reply = replay.insert(&Chunk::zeroed(header));
    replay.check_valid();
    reply
}

pub(crate) fn stored(inserted_total: u64) -> InsertReply {
    InsertReply::Stored { inserted_total }
}

fn is_refused(reply: &InsertReply) -> bool {
    matches!(reply, InsertReply::Refused { .. })
}

proptest! {
    #[test]
    fn delays_repeats_and_drops_change_nothing(seed in any::<u64>(), actors in 1u32..4, chunks in 1u64..30) {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let mut config = unlimited(10_000);
        // A limiter that blocks now and then; the learner below frees it.
        (config.replay_ratio, config.slack_transitions) = (1.0, 16);
        let mut replay = Replay::new(&small_spec(), &config, 8).unwrap();
        let mut next = vec![0u64; actors as usize];
        let mut in_flight: Vec<ChunkHeader> = vec![];
        let steps = |actor: u32, sequence: u64| 1 + (u64::from(actor) * 7 + sequence * 3) % 5;
        let first = |actor: u32, sequence: u64| (0..sequence).map(|s| 2 * steps(actor, s)).sum::<u64>();
        while next.iter().any(|&sequence| sequence < chunks) {
            let actor = rng.random_range(0..actors);
            // Send the chunk that the actor thinks is due, or one of the window after it.
            let sequence = (next[actor as usize] + rng.random_range(0..3)).min(chunks - 1);
            let header = header(actor, 9, sequence, first(actor, sequence));
            in_flight.push(ChunkHeader { steps: steps(actor, sequence) as u32, ..header });
            // Any message of those in flight arrives; it may stay in flight and arrive again.
            let at = rng.random_range(0..in_flight.len());
            let arrived = if rng.random_bool(0.7) { in_flight.swap_remove(at) } else { in_flight[at] };
            let reply = insert(&mut replay, arrived);
            let lost_answer = rng.random_bool(0.3);
            match reply {
                InsertReply::Stored { .. } if !lost_answer => {
                    let next = &mut next[arrived.actor as usize];
                    *next = (*next).max(arrived.sequence + 1);
                }
                InsertReply::OutOfOrder { expected } => {
                    prop_assert!(expected < arrived.sequence);
                    if !lost_answer {
                        next[arrived.actor as usize] = expected;
                    }
                }
                InsertReply::Stored { .. } | InsertReply::Wait { .. } => {}
                InsertReply::Finished { .. } | InsertReply::Refused { .. } => panic!("{reply:?}"),
            }
            let _ = replay.sample(8);
            in_flight.truncate(20);
        }
        let produced: Vec<u64> = (0..actors).map(|actor| first(actor, chunks)).collect();
        for (actor, &produced) in produced.iter().enumerate() {
            replay.goodbye(&Goodbye { actor: actor as u32, epoch: 9, produced });
        }
        let status = replay.status();
        prop_assert_eq!(status.transitions_inserted, produced.iter().sum::<u64>());
        prop_assert_eq!((status.transitions_lost, status.transitions_duplicated), (0, 0));
        prop_assert_eq!(status.messages_refused, 0);
    }

    #[test]
    fn batches_that_do_not_arrive_do_not_count(seed in any::<u64>(), askers in 1u64..4, batches in 1u64..30) {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let mut config = unlimited(10_000);
        (config.replay_ratio, config.slack_transitions) = (1.0, 10_000);
        config.transitions_max = Some(8 * batches);
        let spec = spec(3, 1, 1, Horizon::Uniform { k_max: 3 });
        let mut replay = Replay::new(&spec, &config, 8).unwrap();
        for sequence in 0.. {
            let header = ChunkHeader { steps: 4, ..header(0, 9, sequence, 8 * sequence) };
            if insert(&mut replay, header) != stored(8 * (sequence + 1)) {
                break;
            }
        }
        let mut asked: Vec<_> = (0..askers).map(RequestId::first).collect();
        let mut ks = vec![0; 4];
        let (mut arrived, mut lost) = (0, 0);
        // What was sent, overtaken requests too, in the order of its arrival.
        let mut in_flight: Vec<RequestId> = vec![];
        for _ in 0..20_000 {
            if arrived == batches {
                break;
            }
            let asker = rng.random_range(0..askers) as usize;
            asked[asker] = asked[asker].again();
            in_flight.push(asked[asker]);
            let at = rng.random_range(0..in_flight.len());
            let id = in_flight.remove(at);
            in_flight.truncate(20);
            let draft = replay.draw_for(id, 8, Planes::zeroed);
            replay.check_valid();
            let is_awaited = asked[id.asker as usize] == id;
            match draft {
                Ok(draft) if is_awaited && rng.random_bool(0.7) => {
                    arrived += 1;
                    draft.unpack().ks().iter().for_each(|&k| ks[usize::from(k)] += 1);
                    asked[id.asker as usize] = id.next();
                }
                Ok(_) => lost += 1,
                Err(Unready::Finished | Unready::Wait(_)) => {}
                Err(refused) => panic!("{refused:?}"),
            }
        }
        let status = replay.status();
        prop_assert_eq!((arrived, status.rows_sampled), (batches, 8 * batches));
        prop_assert_eq!((status.batches_retried, status.k_histogram), (lost, ks));
    }
}

#[test]
fn what_never_arrived_counts_as_lost_once() {
    let mut replay = Replay::new(&small_spec(), &unlimited(1000), 8).unwrap();
    assert_eq!(insert(&mut replay, header(0, 1, 0, 4)), stored(6));
    assert_eq!(
        replay.status().transitions_lost,
        4,
        "before the first chunk"
    );
    assert_eq!(insert(&mut replay, header(0, 1, 1, 10)), stored(12));
    assert_eq!(insert(&mut replay, header(0, 1, 2, 17)), stored(18));
    assert_eq!(replay.status().transitions_lost, 5, "between chunks");
    let goodbye = Goodbye {
        actor: 0,
        epoch: 1,
        produced: 30,
    };
    replay.goodbye(&goodbye);
    replay.goodbye(&goodbye);
    assert_eq!(
        replay.status().transitions_lost,
        12,
        "after the last chunk, heard twice"
    );
    replay.goodbye(&Goodbye {
        actor: 1,
        epoch: 1,
        produced: 3,
    });
    assert_eq!(
        replay.status().transitions_lost,
        15,
        "an actor of which nothing arrived"
    );
    assert_eq!(replay.status().transitions_duplicated, 0);
}

#[test]
fn what_was_stored_and_never_produced_counts_as_duplicated() {
    let mut replay = Replay::new(&small_spec(), &unlimited(1000), 8).unwrap();
    insert(&mut replay, header(0, 1, 0, 0));
    insert(&mut replay, header(0, 1, 1, 4));
    assert_eq!(replay.status().transitions_duplicated, 2);
    replay.goodbye(&Goodbye {
        actor: 0,
        epoch: 1,
        produced: 9,
    });
    assert_eq!(replay.status().transitions_duplicated, 3);
    replay.goodbye(&Goodbye {
        actor: 0,
        epoch: 0,
        produced: u64::MAX,
    });
    replay.goodbye(&Goodbye {
        actor: 1,
        epoch: 0,
        produced: u64::MAX,
    });
    assert_eq!(
        replay.status().transitions_lost,
        u64::MAX,
        "absurd counts do not overflow"
    );
}

#[test]
fn after_goodbye_or_a_new_start_only_retries_are_answered_stored() {
    let mut replay = Replay::new(&small_spec(), &unlimited(1000), 8).unwrap();
    insert(&mut replay, header(0, 1, 0, 0));
    replay.goodbye(&Goodbye {
        actor: 0,
        epoch: 1,
        produced: 6,
    });
    assert_eq!(insert(&mut replay, header(0, 1, 0, 0)), stored(6));
    assert!(is_refused(&insert(&mut replay, header(0, 1, 1, 6))));
    assert_eq!(
        insert(&mut replay, header(0, 2, 1, 6)),
        InsertReply::OutOfOrder { expected: 0 }
    );
    assert_eq!(insert(&mut replay, header(0, 2, 0, 0)), stored(12));
    assert!(
        is_refused(&insert(&mut replay, header(0, 1, 0, 0))),
        "a past life"
    );
    let status = replay.status();
    assert_eq!(
        (
            status.chunks_retried,
            status.messages_refused,
            status.transitions_lost
        ),
        (1, 2, 0)
    );
}

#[test]
fn unfit_chunks_are_refused_with_a_reason() {
    let mut replay = Replay::new(&small_spec(), &unlimited(100), 8).unwrap();
    insert(&mut replay, header(0, 1, 0, 0));
    let good = header(0, 1, 1, 6);
    let unfit = [
        (
            "frames of 7 bytes",
            ChunkHeader {
                frame_bytes: 7,
                ..good
            },
        ),
        ("3 streams after 2", ChunkHeader { streams: 3, ..good }),
        ("102 transitions", ChunkHeader { steps: 51, ..good }),
        ("0 transitions", ChunkHeader { steps: 0, ..good }),
        (
            "counts that no run reaches",
            ChunkHeader {
                first_transition: u64::MAX,
                ..good
            },
        ),
        (
            "counts that no run reaches",
            ChunkHeader {
                sequence: u64::MAX,
                ..good
            },
        ),
    ];
    for (reason, header) in unfit {
        match insert(&mut replay, header) {
            InsertReply::Refused { why } => assert!(why.contains(reason), "{why}"),
            reply => panic!("{reply:?} for {header:?}"),
        }
    }
    let mut chunk = Chunk::zeroed(good);
    chunk.set(2, 5, 0.0, End::Running);
    assert!(is_refused(&replay.insert(&chunk)), "action 5 of 0..5");
    assert_eq!(replay.status().messages_refused, unfit.len() as u64 + 1);
    assert_eq!(insert(&mut replay, good), stored(12), "the actor goes on");
}

#[test]
fn actors_and_streams_are_bounded() {
    let mut replay = Replay::new(&small_spec(), &unlimited(1 << 15), 8).unwrap();
    for actor in 0..ACTORS_MAX as u32 {
        assert!(matches!(
            replay.insert(&Chunk::zeroed(header(actor, 1, 0, 0))),
            InsertReply::Stored { .. }
        ));
    }
    let one_more = ACTORS_MAX as u32;
    assert!(is_refused(&insert(&mut replay, header(one_more, 1, 0, 0))));
    replay.goodbye(&Goodbye {
        actor: one_more,
        epoch: 1,
        produced: 6,
    });
    assert_eq!(replay.status().transitions_lost, 0);
    let last = header(one_more - 1, 1, 1, 6);
    assert!(
        matches!(insert(&mut replay, last), InsertReply::Stored { .. }),
        "the known ones go on"
    );
    let wide = ChunkHeader {
        streams: STREAMS_MAX + 1,
        steps: 1,
        ..header(0, 2, 0, 0)
    };
    assert!(is_refused(&insert(&mut replay, wide)));
}

#[test]
fn the_run_ends_when_all_is_in_and_sampled() {
    let mut config = unlimited(1000);
    (
        config.replay_ratio,
        config.slack_transitions,
        config.warmup_transitions,
    ) = (4.0, 6, 6);
    config.transitions_max = Some(18);
    let mut replay = Replay::new(&small_spec(), &config, 8).unwrap();
    assert_eq!(replay.waiting(), Waiting::WarmUp { have: 0, need: 6 });
    assert_eq!(
        replay.sample(8),
        Err(Unready::Wait(Waiting::WarmUp { have: 0, need: 6 }))
    );
    assert_eq!(insert(&mut replay, header(0, 1, 0, 0)), stored(6));
    assert_eq!(
        replay.sample(8),
        Err(Unready::Wait(Waiting::LearnerWaitsForActors))
    );
    assert_eq!(insert(&mut replay, header(0, 1, 1, 6)), stored(12));
    assert_eq!(
        insert(&mut replay, header(1, 1, 0, 0)),
        stored(18),
        "6 ahead, of a slack of 6"
    );
    assert!(replay.status().finished);
    assert_eq!(
        insert(&mut replay, header(0, 1, 1, 6)),
        stored(18),
        "a retry is still a retry"
    );
    assert_eq!(
        insert(&mut replay, header(0, 1, 2, 12)),
        InsertReply::Finished { inserted_total: 18 }
    );
    assert_eq!(
        insert(&mut replay, header(0, 1, 7, 12)),
        InsertReply::Finished { inserted_total: 18 }
    );
    for _ in 0..6 {
        replay.sample(8).unwrap();
    }
    assert_eq!(replay.sample(8), Err(Unready::Finished));
    assert_eq!(replay.waiting(), Waiting::Finished);
    assert_eq!(
        replay.status().replay_ratio(),
        Some(4.0),
        "48 rows of 12 transitions after the warm-up"
    );
    replay.goodbye(&Goodbye {
        actor: 0,
        epoch: 1,
        produced: 12,
    });
    assert_eq!(replay.status().transitions_lost, 0);
}

#[test]
fn a_blocked_insert_waits_and_what_can_never_be_served_is_refused() {
    let mut config = unlimited(1000);
    (config.replay_ratio, config.slack_transitions) = (4.0, 2);
    let mut replay = Replay::new(&small_spec(), &config, 8).unwrap();
    assert_eq!(insert(&mut replay, header(0, 1, 0, 0)), stored(6));
    assert_eq!(
        insert(&mut replay, header(0, 1, 1, 6)),
        InsertReply::Wait { inserted_total: 6 }
    );
    assert_eq!(
        insert(&mut replay, header(0, 1, 2, 12)),
        InsertReply::OutOfOrder { expected: 1 }
    );
    assert_eq!(replay.waiting(), Waiting::ActorsWaitForLearner);
    assert!(
        matches!(replay.sample(9), Err(Unready::Refused { .. })),
        "more than slack * ratio rows"
    );
    assert!(matches!(replay.sample(0), Err(Unready::Refused { .. })));
    let leaving = ChunkHeader {
        leaving: true,
        ..header(1, 1, 0, 0)
    };
    assert_eq!(
        insert(&mut replay, leaving),
        stored(12),
        "an actor that leaves does not wait"
    );
    for _ in 0..5 {
        replay.sample(8).unwrap();
    }
    assert_eq!(insert(&mut replay, header(0, 1, 1, 6)), stored(18));
    assert!(replay.set_replay_ratio(3.9).is_err(), "2 * 3.9 < 8");
    replay.set_replay_ratio(8.0).unwrap();
    let foreign = AffinityUpdate {
        version: 1,
        num_actions: 4,
        matrix: vec![0.25; 16],
    };
    assert!(replay.set_affinity(&foreign).is_err());
    assert_eq!(replay.status().messages_refused, 3);
}

/// The same seed and the same calls give the same batches; another seed gives others.
#[test]
fn batches_follow_from_the_seed() {
    let batches = |seed| {
        let spec = RunSpec {
            seed,
            horizon: Horizon::Uniform { k_max: 3 },
            ..small_spec()
        };
        let mut replay = Replay::new(&spec, &unlimited(1000), 8).unwrap();
        let mut chunk = Chunk::zeroed(ChunkHeader {
            steps: 100,
            ..header(0, 1, 0, 0)
        });
        for row in 0..200 {
            chunk.set(row, (row % 5) as u8, row as f32, End::Running);
        }
        replay.insert(&chunk);
        [replay.sample(32).unwrap(), replay.sample(32).unwrap()]
    };
    assert_eq!(batches(1), batches(1));
    assert_ne!(batches(1), batches(2));
    let [first, second] = batches(1);
    assert_ne!(first, second);
}
